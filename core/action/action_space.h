// What a policy may answer: Gymnasium's Discrete or Box action space.
//
// Plain values; const members are safe to call from many threads.
#ifndef CORE_ACTION_ACTION_SPACE_H_
#define CORE_ACTION_ACTION_SPACE_H_

#include <vector>

#include "absl/status/status.h"
#include "absl/types/span.h"

namespace spikeserve {

// One action in environment units.
struct Action {
  int discrete = 0;               // index, where the space is Discrete
  std::vector<float> continuous;  // [low.size()], where the space is a Box; empty otherwise

  friend bool operator==(const Action&, const Action&) = default;
};

struct ActionSpace {
  int n = 0;               // Discrete: number of actions; 0 where the space is a Box
  std::vector<float> low;  // Box: bounds in environment units, both [size()]
  std::vector<float> high;

  static ActionSpace Discrete(int n) { return {.n = n, .low = {}, .high = {}}; }
  static ActionSpace Box(std::vector<float> low, std::vector<float> high) {
    return {.n = 0, .low = std::move(low), .high = std::move(high)};
  }

  bool is_discrete() const { return n > 0; }
  // Outputs of the action head, and inputs of the action embedding.
  int size() const { return is_discrete() ? n : static_cast<int>(low.size()); }

  // Writes the action token's input into `encoded` [size()]: one-hot for a Discrete space, the
  // affine map of [low, high] to [-1, 1] for a Box. REQUIRES: Contains(action).
  void Encode(const Action& action, absl::Span<float> encoded) const;

  // The affine map of [-1, 1] to [low[i], high[i]] for every element, clamped to the bounds.
  // REQUIRES: a Box space; `unit` is [size()].
  std::vector<float> FromUnit(absl::Span<const float> unit) const;
  // Of element i alone.
  float FromUnit(float unit, size_t i) const;

  // OK if `action` is of this space: an index in [0, n), or finite values within the bounds.
  absl::Status Contains(const Action& action) const;

  // INVALID_ARGUMENT unless n >= 1 alone, or finite bounds of one length with low < high.
  absl::Status Validate() const;

  friend bool operator==(const ActionSpace&, const ActionSpace&) = default;
};

}  // namespace spikeserve

#endif  // CORE_ACTION_ACTION_SPACE_H_
