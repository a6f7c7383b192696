// The experiment of `spikectl adapt`: plays a task, whose physics may be perturbed, with learning
// enabled, and then evaluates the learned head.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/environment/perturbation.h"
#include "spikeserve/client.h"

namespace spikeserve {

struct AdaptationOptions {
  std::string environment;
  std::optional<Perturbation> perturbation;  // absent: the unperturbed task
  v1::PolicyInfo policy;                     // the policy of all sessions
  v1::LearningConfig learning;               // of every learning session
  double temperature = 1.0;                  // for sampling the actions of learning sessions
  int sessions = 1;                          // number of concurrent learning sessions
  int episodes = 1;                          // per learning session
  uint64_t seed = 0;  // session i plays episode e from start seed + e * sessions + i
  int evaluation_episodes = 50;
  uint64_t evaluation_seed = 1'000'000;  // added to `seed`: the first start for evaluation
};

struct Adaptation {
  // Mean returns of the greedy policy over starts that were not used for learning.
  double unperturbed_return = 0.0;  // the policy's own head in the unperturbed task
  double frozen_return = 0.0;       // the policy's own head in the perturbed task
  double adapted_return = 0.0;      // the learned head in the perturbed task
  std::vector<double> curve;        // return of each learning episode, the mean over the sessions
  double head_drift = 0.0;          // |W - W_base| / |W_base| of the learned head
  int64_t rollbacks = 0;            // number of rollbacks by the guard
};

// Creates the environment that is learned. Returns the errors of MakeEnvironment and
// MakePerturbedEnvironment.
absl::StatusOr<std::unique_ptr<Environment>> MakeTask(const AdaptationOptions& options);

// Runs the experiment. Calls `on_episode(e, curve[e])` when all sessions have finished episode e,
// in order. Returns the errors of the environments and of the calls.
absl::StatusOr<Adaptation> Adapt(Client& client, const AdaptationOptions& options,
                                 const std::function<void(int, double)>& on_episode);

// Returns one line of the learning curve, with a bar that is empty for `low` and full for `high`.
std::string CurveLine(int episode, double value, double low, double high);

}  // namespace spikeserve
