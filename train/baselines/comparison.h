// Compares a policy with baselines that were fitted on the same data: errors on held-out steps,
// and returns on equal starts where this program has the environment.
//
//   const auto data = ReadBaselineData(source, /*validation=*/0.1);
//   if (NeedsChanges(space, data->training)) ...
//   const BaselineComparison comparison = CompareWithBaselines(policy, *data, seed);
//
// Free functions without shared state.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "nlohmann/json.hpp"
#include "train/baselines/baseline.h"
#include "train/baselines/imitation_error.h"
#include "train/baselines/step_table.h"
#include "train/data/episode_source.h"

namespace spikeserve {

struct BaselineData {
  StepTable training;
  StepTable held_out;
  // Whether `held_out` contains other episodes than `training`; not if no episodes are held out.
  bool is_held_out = true;
};

// Reads all steps to fit baselines if their inputs are at most a million numbers, and episodes
// that have about as many, evenly spaced, otherwise; and 10,000 held-out steps. `validation` is the
// share of the episodes that the trainer holds out. INVALID_ARGUMENT if observations have more than
// kMostBaselineInputs numbers. Fails if a file can no longer be read.
absl::StatusOr<BaselineData> ReadBaselineData(const EpisodeSource& source, double validation);

// Returns whether two observations are clearly better than the last one: by two standard errors,
// and for a linear map by at least 5 % of its error, for a perceptron by 25 % and 0.01. Each is
// fitted to one half of the episodes and tested on the other half. If so, the action depends on how
// the observation changes, for example on a velocity that is not observed. Takes some seconds.
bool NeedsChanges(const ActionSpace& space, const StepTable& table);

struct BaselineScore {
  Baseline baseline;
  ImitationError error;
  std::vector<double> returns = {};  // of each start; empty if they were not played
};

struct BaselineComparison {
  bool is_discrete = false;
  bool is_held_out = true;
  Eigen::Index steps = 0;  // on which the errors were measured
  ImitationError policy;
  std::vector<double> policy_returns = {};  // as those of the baselines
  std::vector<BaselineScore> baselines;
};

// Fits lines and perceptrons on 1, 2 and 4 observations, in seconds to a minute, and measures all
// errors. A perceptron is the best on the held-out steps of two widths and three seeds, so its
// error there is a little low; its returns are not.
BaselineComparison CompareWithBaselines(std::shared_ptr<const Policy> policy,
                                        const BaselineData& data, uint64_t seed);

// Plays every baseline in `environment` on the starts of `policy_returns`, from `first_seed` on.
// NOT_FOUND for an unknown environment.
absl::Status PlayBaselines(absl::string_view environment, uint64_t first_seed,
                           std::vector<double> policy_returns, BaselineComparison* comparison);

// Returns one line for each baseline that is better than the policy by more than two standard
// errors, in error or return, and says by how much. One episode or start says nothing.
std::vector<std::string> Warnings(const BaselineComparison& comparison);

// A table for the terminal, followed by the warnings.
std::string ToText(const BaselineComparison& comparison);

// All figures and warnings. `with_weights` adds what is needed to play the baselines.
nlohmann::ordered_json ToJson(const BaselineComparison& comparison, bool with_weights);

}  // namespace spikeserve
