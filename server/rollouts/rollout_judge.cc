#include "server/rollouts/rollout_judge.h"

#include <algorithm>
#include <cmath>

#include "absl/strings/str_format.h"
#include "server/rollouts/sequential_test.h"

namespace spikeserve {
namespace {

using Counts = VersionEvidence::Counts;

constexpr double kQuantile = 0.99;

// A comparison, the size of typical observations, and the values that a sentence shows.
struct Judged {
  Comparison comparison;
  double scale = 0.0;
  std::string values;
};

double ShareOf(int64_t part, int64_t all) {
  return all == 0 ? 0.0 : static_cast<double>(part) / static_cast<double>(all);
}

Judged JudgeReturn(double margin, const Counts& fresh, const Counts& stable) {
  const double allowed = margin * std::abs(stable.return_mean);
  return {{.difference = stable.return_mean - allowed - fresh.return_mean,
           .new_variance = fresh.return_variance(),
           .stable_variance = stable.return_variance(),
           .new_count = fresh.episodes,
           .stable_count = stable.episodes},
          std::max(std::abs(stable.return_mean), std::abs(fresh.return_mean)),
          absl::StrFormat("mean return %.4g over %d episodes, stable version %.4g over %d",
                          fresh.return_mean, fresh.episodes, stable.return_mean, stable.episodes)};
}

Judged JudgeErrors(double margin, const Counts& fresh, const Counts& stable) {
  const double fresh_share = ShareOf(fresh.failed_sessions, fresh.sessions);
  const double stable_share = ShareOf(stable.failed_sessions, stable.sessions);
  // If there is no difference, both shares are those of all sessions together. One failure that has
  // not happened yet keeps the variance above 0.
  const double pooled = ShareOf(fresh.failed_sessions + stable.failed_sessions + 1,
                                fresh.sessions + stable.sessions + 2);
  const double variance = pooled * (1.0 - pooled);
  return {{.difference = fresh_share - stable_share - margin,
           .new_variance = variance,
           .stable_variance = variance,
           .new_count = fresh.sessions,
           .stable_count = stable.sessions},
          1.0,
          absl::StrFormat("%d of %d sessions had errors, stable version %d of %d",
                          fresh.failed_sessions, fresh.sessions, stable.failed_sessions,
                          stable.sessions)};
}

// Compares the share of slow decisions: those above the stable version's 99th percentile with the
// margin, of which the stable version makes at most 1 %.
Judged JudgeP99(double margin, const Counts& fresh, const Counts& stable) {
  const double p99 = stable.durations.Quantile(kQuantile);
  const int64_t total = fresh.durations.total();
  const double slow = ShareOf(fresh.durations.CountAbove((1.0 + margin) * p99), total);
  constexpr double kVariance = kQuantile * (1.0 - kQuantile);
  return {{.difference = slow - (1.0 - kQuantile),
           .new_variance = kVariance,
           .stable_variance = kVariance,
           .new_count = total,
           .stable_count = stable.durations.total()},
          1.0,
          absl::StrFormat("p99 %.3g ms, stable version %.3g ms",
                          1e3 * fresh.durations.Quantile(kQuantile), 1e3 * p99)};
}

Judged Judge(const RolloutCondition& condition, const Counts& fresh, const Counts& stable) {
  switch (condition.measure) {
    case RolloutMeasure::kReturn:
      return JudgeReturn(condition.margin, fresh, stable);
    case RolloutMeasure::kErrors:
      return JudgeErrors(condition.margin, fresh, stable);
    case RolloutMeasure::kP99:
      break;
  }
  return JudgeP99(condition.margin, fresh, stable);
}

}  // namespace

std::vector<RolloutCondition> DefaultConditions() {
  return {{.measure = RolloutMeasure::kReturn, .margin = 0.0},
          {.measure = RolloutMeasure::kErrors, .margin = 0.01},
          {.measure = RolloutMeasure::kP99, .margin = 0.25}};
}

std::string FindWorse(const std::vector<RolloutCondition>& conditions, const Counts& new_version,
                      const Counts& stable_version) {
  const double threshold = std::log(static_cast<double>(conditions.size()) / kFalseAborts);
  for (const RolloutCondition& condition : conditions) {
    const Judged judged = Judge(condition, new_version, stable_version);
    if (LogWorseRatio(judged.comparison, judged.scale) < threshold) continue;
    return absl::StrFormat("%s is worse: %s (margin %g)", ToString(condition.measure),
                           judged.values, condition.margin);
  }
  return "";
}

}  // namespace spikeserve
