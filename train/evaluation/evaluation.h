// Plays a policy in closed loop in its environment, with the same engine that the server uses.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/engine/counts.h"
#include "core/model/policy.h"
#include "nlohmann/json.hpp"
#include "train/data/delay_range.h"

namespace spikeserve {

struct EvaluationOptions {
  int episodes = 100;
  uint64_t first_seed = 1'000'000;  // episode i starts from Environment::Reset(first_seed + i)
  // Episodes take turns with the delays of the range. Until the first decision arrives, action 0 is
  // executed, or the middle of bounds that exclude 0; the policy is told what was executed.
  DelayRange delay = {};

  absl::Status Validate() const;
};

struct Evaluation {
  EvaluationOptions options;
  std::string environment;
  std::vector<double> returns;  // per episode
  uint64_t decisions = 0;
  Counts counts;  // sums over all decisions

  double mean_return() const;
  double std_return() const;  // population standard deviation over the episodes: divided by n
  double spikes_per_decision() const;
};

// Plays the policy greedily, conditioned on its target return. Returns INVALID_ARGUMENT for invalid
// options or if the policy does not fit its environment, NOT_FOUND for an unknown environment.
absl::StatusOr<Evaluation> Evaluate(std::shared_ptr<const Policy> policy,
                                    const EvaluationOptions& options);

// Converts an evaluation to JSON. The name of every figure states its denominator: per decision
// (its three new tokens), per token and tick (the paper's S-bar), or per window (N decisions, the
// paper's "inference").
nlohmann::ordered_json ToJson(const Evaluation& evaluation, const ModelConfig& config);

// Formats an evaluation as text for the terminal.
std::string ToText(const Evaluation& evaluation, const ModelConfig& config);

}  // namespace spikeserve
