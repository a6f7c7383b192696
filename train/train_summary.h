// Says at the end of a training what was made and how to continue.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <array>
#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "core/base/enum_names.h"
#include "core/model/policy.h"
#include "nlohmann/json.hpp"
#include "train/baselines/comparison.h"
#include "train/baselines/verdict.h"
#include "train/data/episode_source.h"
#include "train/evaluation/evaluation.h"
#include "train/evaluation/rounding_loss.h"

namespace spikeserve {

// Where the target return of a policy comes from.
enum class TargetSource { kFlag, kInitialPolicy, kEnvironment, kData };

constexpr std::array<EnumName<TargetSource>, 4> EnumNames(TargetSource) {
  return {{{TargetSource::kFlag, "flag"},
           {TargetSource::kInitialPolicy, "initial_policy"},
           {TargetSource::kEnvironment, "environment"},
           {TargetSource::kData, "data"}}};
}

struct TrainSummary {
  std::string path;  // of the policy file
  TargetSource target_source;
  double validation_loss;                // below 0: no episodes were held out
  std::optional<Evaluation> evaluation;  // absent: the environment cannot be played here
  std::optional<RoundingLoss> loss;      // absent: not in integers, or of no float32 policy
  double spikes_on_data;                 // per decision; see SpikesOnData
  PolicyVerdict verdict;
  // Absent with --no_baselines, and for observations that are too large.
  std::optional<BaselineComparison> comparison;
};

// Returns the spikes per decision of a policy that is shown the observations and rewards of the
// first 1000 steps of `source`, whatever actions it takes. Fails if they can no longer be read.
absl::StatusOr<double> SpikesOnData(const Policy& policy, const EpisodeSource& source);

std::string ToText(const TrainSummary& summary, const Policy& policy);

// Returns the evaluation, if there is one, and the summary.
nlohmann::ordered_json ToJson(const TrainSummary& summary, const Policy& policy);

}  // namespace spikeserve
