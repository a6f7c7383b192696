// Gymnasium's classic-control environments, step for step.
//
// An environment is not thread-safe; each agent owns its own.
#ifndef CORE_ENVIRONMENT_ENVIRONMENT_H_
#define CORE_ENVIRONMENT_ENVIRONMENT_H_

#include <cstdint>
#include <memory>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "core/action/action_space.h"

namespace spikeserve {

// What Gymnasium's step() returns.
struct StepResult {
  std::vector<float> observation;
  double reward = 0.0;
  bool terminated = false;
  bool truncated = false;

  bool done() const { return terminated || truncated; }
};

class Environment {
 public:
  virtual ~Environment() = default;

  virtual absl::string_view id() const = 0;  // Gymnasium's id
  virtual int observation_size() const = 0;
  virtual const ActionSpace& action_space() const = 0;
  virtual int max_episode_steps() const = 0;  // the TimeLimit of Gymnasium's registry

  // Starts an episode from the initial state Gymnasium draws for this seed (NumPy's PCG64, bit for
  // bit), and returns its first observation.
  virtual std::vector<float> Reset(uint64_t seed) = 0;

  // Starts an episode from a given internal state (float64, Gymnasium's `unwrapped.state`).
  // REQUIRES: state.size() == this->state().size().
  virtual std::vector<float> ResetTo(absl::Span<const double> state) = 0;

  // One step. REQUIRES: Reset was called and the episode has not ended; the action is of
  // action_space().
  virtual StepResult Step(const Action& action) = 0;

  // The internal state in float64, as Gymnasium's `unwrapped.state`.
  virtual absl::Span<const double> state() const = 0;
};

// "CartPole-v1", "MountainCar-v0", "Acrobot-v1", "Pendulum-v1", "PositionOnlyCartPole-v1" or
// "PositionOnlyPendulum-v1"; NOT_FOUND names the ids there are.
absl::StatusOr<std::unique_ptr<Environment>> MakeEnvironment(absl::string_view id);

}  // namespace spikeserve

#endif  // CORE_ENVIRONMENT_ENVIRONMENT_H_
