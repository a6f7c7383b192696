// Implements what the classic-control tasks have in common: the state in float64, the step count of
// the episode and the time limit.
//
// A task defines four functions: the initial state, the dynamics, the terminal states and the
// observation. Each function computes in the order of operations of Gymnasium 1.x, so that a step
// differs from Gymnasium's only by the rounding of sine and cosine.
//
// Not thread-safe. A copy of an environment continues the episode independently.
#pragma once

#include <cstdint>
#include <vector>

#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "core/action/action_space.h"
#include "core/environment/environment.h"
#include "core/environment/numpy_random.h"

namespace spikeserve {

// Base class of the classic-control tasks.
class ClassicControl : public Environment {
 public:
  absl::string_view id() const final { return spec_.id; }
  int observation_size() const final { return spec_.observation_size; }
  const ActionSpace& action_space() const final { return spec_.action_space; }
  int max_episode_steps() const final { return spec_.max_episode_steps; }
  absl::Span<const double> state() const final { return state_; }

  std::vector<float> Reset(uint64_t seed) final;
  std::vector<float> ResetTo(absl::Span<const double> state) final;
  StepResult Step(const Action& action) final;

  // Advances `state` [state_size] by one step and returns the reward. Independent of the running
  // episode, so that planners can call it; pure and thread-safe.
  virtual double Advance(const Action& action, absl::Span<double> state) const = 0;
  // Returns whether an episode terminates when it reaches `state` [state_size]. Pure and
  // thread-safe.
  virtual bool IsTerminal(absl::Span<const double> state) const = 0;

 protected:
  struct Spec {
    absl::string_view id;
    int state_size = 0;
    int observation_size = 0;
    ActionSpace action_space;
    int max_episode_steps = 0;
  };

  explicit ClassicControl(Spec spec);

  // Draws the initial state of an episode, [state_size].
  virtual std::vector<double> DrawInitialState(NumpyRandom& random) const = 0;
  // Returns the observation of `state`, [observation_size].
  virtual std::vector<float> Observe(absl::Span<const double> state) const = 0;

 private:
  Spec spec_;
  std::vector<double> state_;  // [state_size]
  int steps_ = 0;              // number of steps in this episode
  bool running_ = false;       // true from a reset to the end of the episode
};

}  // namespace spikeserve
