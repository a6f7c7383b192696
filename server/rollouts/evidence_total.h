// Adds up the evidence of two versions over tenants, so that one session, and one tenant, weigh
// little.
//
// Pure functions; safe to call from many threads.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "server/metrics/version_evidence.h"

namespace spikeserve {

// The mean of the values without the lowest and the highest tenth of them (at least one each, if
// there are three values or more).
struct TrimmedMean {
  int64_t count = 0;  // values, with those that are left out
  double mean = 0.0;
  // `count` times the variance of `mean`, by the winsorized variance (Yuen, "The two-sample trimmed
  // t for unequal population variances", 1974).
  double variance = 0.0;
};

// Reorders `values`.
TrimmedMean TrimmedMeanOf(std::vector<double>& values);

// What the sessions of a version did, over tenants.
struct EvidenceTotal {
  int64_t sessions = 0;
  int64_t failed_sessions = 0;
  int64_t episodes = 0;
  int64_t implausible = 0;
  int64_t capped_episodes = 0;
  TrimmedMean returns;  // of the sessions' mean returns
  DurationCounts durations;
};

// Returns the total without the tenant `without`; null: with all.
EvidenceTotal TotalOf(const VersionEvidence::Counts& counts, const std::string* without = nullptr);

// The mean returns of the sessions of both versions, less the mean of their tenant. Tenants whose
// tasks differ, and who have different shares of both versions, do not seem to be a difference of
// the versions.
struct CenteredReturns {
  TrimmedMean new_version;
  TrimmedMean stable_version;
  std::vector<double> new_values = {};  // in any order
  std::vector<double> stable_values = {};
};

// Compares the tenants that have sessions on both versions, except `without`.
CenteredReturns CenterReturns(const VersionEvidence::Counts& new_version,
                              const VersionEvidence::Counts& stable_version,
                              const std::string* without = nullptr);

}  // namespace spikeserve
