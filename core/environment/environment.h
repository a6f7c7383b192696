// Simulates Gymnasium's classic-control environments, step for step.
//
//   std::unique_ptr<Environment> environment = *MakeEnvironment("CartPole-v1");
//   std::vector<float> observation = environment->Reset(/*seed=*/0);
//   const StepResult result = environment->Step({.discrete = 1, .continuous = {}});
//
// An environment is not thread-safe; each agent owns its own.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "core/action/action_space.h"

namespace spikeserve {

// The result of Gymnasium's step().
struct StepResult {
  std::vector<float> observation;
  double reward = 0.0;
  bool terminated = false;
  bool truncated = false;

  bool done() const { return terminated || truncated; }
};

// The interface of all environments.
class Environment {
 public:
  virtual ~Environment() = default;

  virtual absl::string_view id() const = 0;  // for example "CartPole-v1"
  virtual int observation_size() const = 0;
  virtual const ActionSpace& action_space() const = 0;
  virtual int max_episode_steps() const = 0;  // time limit in Gymnasium's registry

  // Starts an episode and returns its first observation [observation_size]. The initial state is
  // the one that Gymnasium draws for `seed` (from NumPy's PCG64, bit for bit).
  virtual std::vector<float> Reset(uint64_t seed) = 0;

  // Starts an episode in `state`, an internal state in float64 (Gymnasium's `unwrapped.state`), and
  // returns its first observation. REQUIRES: state.size() == this->state().size().
  virtual std::vector<float> ResetTo(absl::Span<const double> state) = 0;

  // Applies `action` for one step. REQUIRES: the episode has been started and has not ended;
  // `action` belongs to action_space().
  virtual StepResult Step(const Action& action) = 0;

  // Returns the internal state in float64 (Gymnasium's `unwrapped.state`).
  virtual absl::Span<const double> state() const = 0;
};

// Makes the environment called `id`: "CartPole-v1", "MountainCar-v0", "Acrobot-v1", "Pendulum-v1",
// "PositionOnlyCartPole-v1" or "PositionOnlyPendulum-v1". NOT_FOUND for any other id; the message
// lists these ids.
absl::StatusOr<std::unique_ptr<Environment>> MakeEnvironment(absl::string_view id);

}  // namespace spikeserve
