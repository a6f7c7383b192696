// The experiment of `spikectl adapt`: a task whose physics may have changed, played with learning
// on, and what the learned head is worth afterwards.
#ifndef CLIENT_SPIKECTL_ADAPTATION_H_
#define CLIENT_SPIKECTL_ADAPTATION_H_

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
  std::optional<Perturbation> perturbation;  // absent: the task as it is
  v1::PolicyInfo policy;                     // to open sessions on
  v1::LearningConfig learning;               // of every learning session
  double temperature = 1.0;                  // at which they sample
  int sessions = 1;                          // that learn at once, each on a thread of its own
  int episodes = 1;                          // of each
  uint64_t seed = 0;  // session i plays episode e from start seed + e * sessions + i
  int evaluation_episodes = 50;
  uint64_t evaluation_seed = 1'000'000;  // the first unseen start, beyond `seed`
};

struct Adaptation {
  // Mean return of the greedy policy over the unseen starts: the policy's own head in the task it
  // was trained for, then in the changed one, then the learned head there.
  double unperturbed_return = 0.0;
  double frozen_return = 0.0;
  double adapted_return = 0.0;
  std::vector<double> curve;  // return of each learning episode, the mean over the sessions
  double head_drift = 0.0;    // of the learned head
  int64_t rollbacks = 0;      // of the guard
};

// The task that is learned. Errors as MakeEnvironment and MakePerturbedEnvironment.
absl::StatusOr<std::unique_ptr<Environment>> MakeTask(const AdaptationOptions& options);

// `on_episode(e, curve[e])` is called as each episode of the curve ends, in order. Errors of the
// environments and of the calls.
absl::StatusOr<Adaptation> Adapt(Client& client, const AdaptationOptions& options,
                                 const std::function<void(int, double)>& on_episode);

// One line of the learning curve: a bar as long as `value` stands between `low` and `high`.
std::string CurveLine(int episode, double value, double low, double high);

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_ADAPTATION_H_
