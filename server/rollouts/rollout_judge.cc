#include "server/rollouts/rollout_judge.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <map>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/math/portable.h"
#include "server/rollouts/evidence_total.h"
#include "server/rollouts/sequential_test.h"

namespace spikeserve {
namespace {

constexpr double kQuantile = 0.99;

// By how much longer a decision has to take, whatever the margin, to be slow: what the scheduler of
// a busy machine takes away at once.
constexpr double kLeastSlowdownSeconds = 0.005;

// What is judged: the evidence of both versions, with or without one tenant.
struct Evidence {
  EvidenceTotal fresh;
  EvidenceTotal stable;
  CenteredReturns centered;
  double trained_range = 0.0;
};

Evidence Gather(const VersionEvidence::Counts& fresh, const VersionEvidence::Counts& stable,
                const std::string* without, double trained_range) {
  return {.fresh = TotalOf(fresh, without),
          .stable = TotalOf(stable, without),
          .centered = CenterReturns(fresh, stable, without),
          .trained_range = trained_range};
}

// A comparison, the size of typical observations, and the values that a sentence shows.
struct Judged {
  Comparison comparison;
  double scale = 0.0;
  std::string values;
  // The observations in [0, 1], of which lower ones are worse, and by how much a mean may be lower;
  // empty: so many that their means are normal.
  std::vector<ObservedValue> fresh = {};
  std::vector<ObservedValue> stable = {};
  double margin = 0.0;
};

double ShareOf(int64_t part, int64_t all) {
  return all == 0 ? 0.0 : static_cast<double>(part) / static_cast<double>(all);
}

// Returns values whose middle is 0 in units of `range`, as numbers in [0, 1].
std::vector<ObservedValue> InRange(const std::vector<double>& values, double range) {
  std::vector<ObservedValue> observed;
  for (const double value : values) {
    observed.push_back({.value = std::clamp(0.5 + value / range, 0.0, 1.0)});
  }
  return observed;
}

Judged JudgeReturn(double margin, const Evidence& evidence) {
  const TrimmedMean& fresh = evidence.fresh.returns;
  const TrimmedMean& stable = evidence.stable.returns;
  const auto& [centered_fresh, centered_stable, new_values, stable_values] = evidence.centered;
  const double allowed = margin * std::abs(stable.mean);
  const bool few = std::min(centered_fresh.count, centered_stable.count) < kFewestNormal;
  double range = evidence.trained_range;
  if (few && std::isinf(range)) {
    range = std::numeric_limits<double>::min();
    for (const auto* values : {&new_values, &stable_values}) {
      for (const double value : *values) range = std::max(range, 2.0 * std::abs(value));
    }
  }
  return {{.difference = centered_stable.mean - allowed - centered_fresh.mean,
           .new_variance = centered_fresh.variance,
           .stable_variance = centered_stable.variance,
           .new_count = centered_fresh.count,
           .stable_count = centered_stable.count},
          std::max(std::abs(stable.mean), std::abs(fresh.mean)),
          absl::StrFormat("mean return %.4g over %d sessions, stable version %.4g over %d",
                          fresh.mean, fresh.count, stable.mean, stable.count),
          InRange(few ? new_values : std::vector<double>(), range),
          InRange(few ? stable_values : std::vector<double>(), range),
          allowed / range};
}

Judged JudgeErrors(double margin, const Evidence& evidence) {
  const EvidenceTotal &fresh = evidence.fresh, &stable = evidence.stable;
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
                          stable.sessions),
          {{0.0, fresh.failed_sessions}, {1.0, fresh.sessions - fresh.failed_sessions}},
          {{0.0, stable.failed_sessions}, {1.0, stable.sessions - stable.failed_sessions}},
          margin};
}

// Compares the share of slow decisions: those above the stable version's 99th percentile with the
// margin, which is at least kLeastSlowdownSeconds. The stable version makes at most 1 % of them.
Judged JudgeP99(double margin, const Evidence& evidence) {
  const DurationCounts& fresh = evidence.fresh.durations;
  const DurationCounts& stable = evidence.stable.durations;
  const double p99 = stable.Quantile(kQuantile);
  const double allowed = std::max(margin * p99, kLeastSlowdownSeconds);
  const double slow = ShareOf(fresh.CountAbove(p99 + allowed), fresh.total());
  constexpr double kVariance = kQuantile * (1.0 - kQuantile);
  return {{.difference = slow - (1.0 - kQuantile),
           .new_variance = kVariance,
           .stable_variance = kVariance,
           .new_count = fresh.total(),
           .stable_count = stable.total()},
          1.0,
          absl::StrFormat("p99 %.3g ms, stable version %.3g ms", 1e3 * fresh.Quantile(kQuantile),
                          1e3 * p99)};
}

Judged Judge(const RolloutCondition& condition, const Evidence& evidence) {
  switch (condition.measure) {
    case RolloutMeasure::kReturn:
      return JudgeReturn(condition.margin, evidence);
    case RolloutMeasure::kErrors:
      return JudgeErrors(condition.margin, evidence);
    case RolloutMeasure::kP99:
      break;
  }
  return JudgeP99(condition.margin, evidence);
}

// Returns the first condition by which the new version is worse, as a sentence, or an empty string.
// A version that is not worse is found with a probability of at most `false_finds`.
std::string FindWorse(const std::vector<RolloutCondition>& conditions, const Evidence& evidence,
                      double false_finds) {
  const double threshold = portable::Log(static_cast<double>(conditions.size()) / false_finds);
  for (const RolloutCondition& condition : conditions) {
    const Judged judged = Judge(condition, evidence);
    const auto& [comparison, scale, values, fresh, stable, margin] = judged;
    if (LogWorseRatio(comparison, scale) < threshold) continue;
    const bool few = std::min(comparison.new_count, comparison.stable_count) < kFewestNormal;
    if (few && !fresh.empty() && LogBettingRatio(fresh, stable, margin) < threshold) continue;
    return absl::StrFormat("%s is worse: %s (margin %g)", ToString(condition.measure), values,
                           condition.margin);
  }
  return "";
}

// Returns the tenants with sessions on either version, those with the most sessions first.
std::vector<std::string> TenantsBySessions(const VersionEvidence::Counts& fresh,
                                           const VersionEvidence::Counts& stable) {
  std::map<std::string, int64_t> sessions;
  for (const auto* counts : {&fresh, &stable}) {
    for (const auto& [tenant, of] : *counts) {
      if (of.sessions > 0) sessions[tenant] += of.sessions;
    }
  }
  std::vector<std::string> tenants;
  tenants.reserve(sessions.size());
  for (const auto& [tenant, count] : sessions) tenants.push_back(tenant);
  std::ranges::stable_sort(tenants, [&](const std::string& a, const std::string& b) {
    return sessions[a] > sessions[b];
  });
  return tenants;
}

}  // namespace

std::vector<RolloutCondition> DefaultConditions() {
  return {{.measure = RolloutMeasure::kReturn, .margin = 0.0},
          {.measure = RolloutMeasure::kErrors, .margin = 0.01},
          {.measure = RolloutMeasure::kP99, .margin = 0.25}};
}

RolloutVerdict JudgeRollout(const std::vector<RolloutCondition>& conditions,
                            const VersionEvidence::Counts& new_version,
                            const VersionEvidence::Counts& stable_version, double trained_range) {
  using Kind = RolloutVerdict::Kind;
  const std::string all = FindWorse(
      conditions, Gather(new_version, stable_version, nullptr, trained_range), kFalseAborts);
  std::vector<std::string> tenants = TenantsBySessions(new_version, stable_version);
  if (tenants.size() > 1) {
    if (tenants.size() > kMostLeftOut) tenants.resize(kMostLeftOut);
    // Several chances to find it worse without a tenant share the probability of one.
    const double false_finds =
        all.empty() ? kFalseAborts / static_cast<double>(tenants.size()) : kFalseAborts;
    for (std::string& tenant : tenants) {
      const Evidence others = Gather(new_version, stable_version, &tenant, trained_range);
      const std::string without = FindWorse(conditions, others, false_finds);
      if (all.empty() == without.empty()) continue;
      const int64_t fewest = std::min(others.fresh.sessions, others.stable.sessions);
      const std::string reason =
          all.empty() ? absl::StrCat("without the sessions of one tenant, ", without)
                      : absl::StrCat(all, ", but not without the sessions of one tenant");
      return {.kind = Kind::kDisputed,
              .reason = reason,
              .tenant = std::move(tenant),
              .contradicted = fewest >= kFewestObservations};
    }
  }
  if (all.empty()) return {};
  return {.kind = Kind::kWorse, .reason = all};
}

Shortfall ShortfallOf(const std::vector<RolloutCondition>& conditions,
                      const VersionEvidence::Counts& new_version,
                      const VersionEvidence::Counts& stable_version) {
  const Evidence evidence = Gather(new_version, stable_version, nullptr, /*trained_range=*/1.0);
  Shortfall most;
  for (const RolloutCondition& condition : conditions) {
    const Comparison comparison = Judge(condition, evidence).comparison;
    most.new_version = std::max(most.new_version, kFewestObservations - comparison.new_count);
    most.stable_version =
        std::max(most.stable_version, kFewestObservations - comparison.stable_count);
  }
  return most;
}

}  // namespace spikeserve
