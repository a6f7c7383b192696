// Plays a policy in closed loop, through the engine that serves it.
#ifndef TRAIN_EVALUATION_EVALUATION_H_
#define TRAIN_EVALUATION_EVALUATION_H_

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/engine/counts.h"
#include "core/model/policy.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

struct EvaluationOptions {
  int episodes = 100;
  uint64_t first_seed = 1'000'000;  // episode i starts from Environment::Reset(first_seed + i)

  absl::Status Validate() const;
};

struct Evaluation {
  EvaluationOptions options;
  std::string environment;
  std::vector<double> returns;  // per episode
  uint64_t decisions = 0;
  Counts counts;  // over all decisions

  double mean_return() const;
  double std_return() const;  // of the episodes, divided by their number
  double spikes_per_decision() const;
};

// Acts greedily, conditioned on the policy's target return. INVALID_ARGUMENT if the policy does not
// fit its environment, NOT_FOUND if there is no such environment.
absl::StatusOr<Evaluation> Evaluate(std::shared_ptr<const Policy> policy,
                                    const EvaluationOptions& options);

// Every figure with its denominator in its name: per decision (its three new tokens), per token and
// tick (the paper's S-bar), and per window (N decisions, the paper's "inference").
nlohmann::ordered_json ToJson(const Evaluation& evaluation, const ModelConfig& config);

// The same, for people.
std::string ToText(const Evaluation& evaluation, const ModelConfig& config);

}  // namespace spikeserve

#endif  // TRAIN_EVALUATION_EVALUATION_H_
