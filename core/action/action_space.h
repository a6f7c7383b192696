// Defines the actions of a policy: Gymnasium's Discrete and Box action spaces.
//
// Plain values; const members are thread-safe.
#pragma once

#include <vector>

#include "absl/status/status.h"
#include "absl/types/span.h"

namespace spikeserve {

// One action in environment units.
struct Action {
  int discrete = 0;               // index of the action, if the space is Discrete
  std::vector<float> continuous;  // [low.size()], if the space is a Box; empty otherwise

  friend bool operator==(const Action&, const Action&) = default;
};

// A Discrete space of n actions, or a Box with bounds.
struct ActionSpace {
  int n = 0;               // Discrete: number of actions; 0 for a Box
  std::vector<float> low;  // Box: bounds in environment units, both [size()]
  std::vector<float> high;

  static ActionSpace Discrete(int n) { return {.n = n, .low = {}, .high = {}}; }
  static ActionSpace Box(std::vector<float> low, std::vector<float> high) {
    return {.n = 0, .low = std::move(low), .high = std::move(high)};
  }

  bool is_discrete() const { return n > 0; }
  // Returns the number of outputs of the action head, which is the number of inputs of the action
  // embedding.
  int size() const { return is_discrete() ? n : static_cast<int>(low.size()); }

  // Writes the action token's input into `encoded` [size()]: one-hot for a Discrete space; for a
  // Box, the values mapped affinely from [low, high] to [-1, 1]. REQUIRES: Contains(action) is OK.
  void Encode(const Action& action, absl::Span<float> encoded) const;

  // Maps each element of `unit` [size()] affinely from [-1, 1] to [low[i], high[i]] and clamps it
  // to these bounds. REQUIRES: a Box space.
  std::vector<float> FromUnit(absl::Span<const float> unit) const;
  // As above, for one element `unit` at index i.
  float FromUnit(float unit, size_t i) const;

  // Returns OK if `action` belongs to this space: an index in [0, n), or finite values within the
  // bounds. INVALID_ARGUMENT otherwise.
  absl::Status Contains(const Action& action) const;

  // Returns INVALID_ARGUMENT unless the space has either n >= 1 and no bounds, or n = 0 and finite
  // bounds of equal length with low < high.
  absl::Status Validate() const;

  friend bool operator==(const ActionSpace&, const ActionSpace&) = default;
};

// Returns the action nearest to doing nothing: index 0, or in each element of a Box 0, if the
// bounds admit it, and otherwise their middle. Thread-safe.
Action NeutralAction(const ActionSpace& space);

}  // namespace spikeserve
