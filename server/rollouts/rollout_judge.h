// Judges whether the new version of a roll-out is worse than the stable version.
//
// Pure functions; safe to call from many threads.
#ifndef SERVER_ROLLOUTS_ROLLOUT_JUDGE_H_
#define SERVER_ROLLOUTS_ROLLOUT_JUDGE_H_

#include <string>
#include <vector>

#include "server/metrics/version_evidence.h"
#include "server/policies/rollout.h"

namespace spikeserve {

// The probability that a version that is not worse is ever judged to be worse, over all conditions
// of a roll-out together.
inline constexpr double kFalseAborts = 0.05;

// Returns the conditions of a roll-out that names none: return with margin 0, errors with 1
// percentage point, p99 with 25 %.
std::vector<RolloutCondition> DefaultConditions();

// Returns the first condition by which the new version is worse, as a sentence with both values, or
// an empty string if the evidence shows none. kFalseAborts is divided by the number of conditions
// (Bonferroni).
std::string FindWorse(const std::vector<RolloutCondition>& conditions,
                      const VersionEvidence::Counts& new_version,
                      const VersionEvidence::Counts& stable_version);

}  // namespace spikeserve

#endif  // SERVER_ROLLOUTS_ROLLOUT_JUDGE_H_
