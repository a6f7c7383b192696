// Stores the last timesteps of an episode in one flat array, so that idle sessions use little
// memory.
//
// A plain value; not thread-safe. Symbols: obs observation length; act number of values of a Box
// action, 0 for Discrete spaces.
#pragma once

#include <cstddef>
#include <vector>

#include "absl/types/span.h"
#include "core/action/action_space.h"

namespace spikeserve {

// One past timestep, as the model saw it.
struct Timestep {
  float return_to_go = 0.0f;
  std::vector<float> observation;  // environment units
  Action action;

  friend bool operator==(const Timestep&, const Timestep&) = default;
};

// A ring of timesteps.
class History {
 public:
  size_t size() const { return stride_ == 0 ? 0 : cells_.size() / stride_; }
  bool empty() const { return cells_.empty(); }

  // Accessors of timestep i, counted from the oldest. REQUIRES: i < size().
  float return_to_go(size_t i) const { return row(i)[0]; }
  absl::Span<const float> observation(size_t i) const;  // valid until the history changes
  Action action(size_t i) const;
  void action(size_t i, Action* action) const;  // reuses the memory of `action`
  Timestep at(size_t i) const;

  // Adds a timestep. If there are `limit` timesteps already, overwrites the oldest. REQUIRES: obs
  // and act are those of the stored timesteps.
  void Append(float return_to_go, absl::Span<const float> observation, const Action& action,
              size_t limit);

  // Replaces the action of the newest timestep. REQUIRES: !empty(); `action` belongs to the same
  // space.
  void ReplaceLastAction(const Action& action);

  // Removes all timesteps, but keeps the memory.
  void Clear();
  // Frees the memory that holds no timestep.
  void ShrinkToFit() { cells_.shrink_to_fit(); }

  friend bool operator==(const History& a, const History& b);

 private:
  size_t begin_of(size_t i) const { return (oldest_ + i) % size() * stride_; }
  const float* row(size_t i) const { return cells_.data() + begin_of(i); }
  void WriteAction(const Action& action, float* row) const;

  size_t observation_size_ = 0;
  size_t stride_ = 0;  // number of floats of a timestep
  size_t oldest_ = 0;  // row of the oldest timestep; the rows are a ring
  // [size][2 + obs + act]: G_t, the bits of the discrete action, the observation, the continuous
  // action.
  std::vector<float> cells_;
};

}  // namespace spikeserve
