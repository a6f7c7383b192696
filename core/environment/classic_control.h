// What the classic-control tasks share: the state in float64, the episode's step count and its time
// limit.
//
// A task adds four functions: where an episode starts, how the state moves, where it ends, and what
// of it is observed. Each computes in the order of operations of Gymnasium 1.x, so that a step
// differs from Gymnasium's by the rounding of sine and cosine at most. Not thread-safe; copying an
// environment forks its episode.
#ifndef CORE_ENVIRONMENT_CLASSIC_CONTROL_H_
#define CORE_ENVIRONMENT_CLASSIC_CONTROL_H_

#include <cstdint>
#include <vector>

#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "core/action/action_space.h"
#include "core/environment/environment.h"
#include "core/environment/numpy_random.h"

namespace spikeserve {

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

  // The model itself, apart from any episode, for planners; pure, safe to call from many threads.
  // Moves `state` [state_size] one step on and returns the reward.
  virtual double Advance(const Action& action, absl::Span<double> state) const = 0;
  // Whether an episode that arrives in `state` [state_size] ends there.
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

  // Draws the state an episode starts from. Returns [state_size].
  virtual std::vector<double> DrawInitialState(NumpyRandom& random) const = 0;
  // What an agent sees of `state`. Returns [observation_size].
  virtual std::vector<float> Observe(absl::Span<const double> state) const = 0;

 private:
  Spec spec_;
  std::vector<double> state_;  // [state_size]
  int steps_ = 0;              // taken in this episode
  bool running_ = false;       // between a reset and the end of its episode
};

}  // namespace spikeserve

#endif  // CORE_ENVIRONMENT_CLASSIC_CONTROL_H_
