// Judges whether the new version of a roll-out is worse than the stable version.
//
// The evidence comes from agents, of which some may lie. Each session counts once, the lowest and
// the highest tenth of the sessions' returns are left out, and a verdict must stand without the
// sessions of any one tenant. docs/design/threat-model.md shows what remains possible.
//
// Pure functions; safe to call from many threads.
#pragma once

#include <string>
#include <vector>

#include "server/metrics/version_evidence.h"
#include "server/policies/rollout.h"

namespace spikeserve {

// The probability that a version that is not worse is ever judged to be worse, over all conditions
// of a roll-out together.
inline constexpr double kFalseAborts = 0.05;

// Returns the conditions of a roll-out that names none: return with margin 0, errors with 1
// percentage point, p99 with 25 %, but 5 ms at least.
std::vector<RolloutCondition> DefaultConditions();

struct RolloutVerdict {
  enum class Kind {
    kNotWorse,
    kWorse,
    kDisputed,  // worse or not, depending on whether the sessions of one tenant count
  };
  Kind kind = Kind::kNotWorse;
  std::string reason = "";  // a sentence with the values of both versions; empty for kNotWorse
  std::string tenant = "";  // kDisputed: whose sessions decide
  // kDisputed: the other tenants have enough sessions on both versions to contradict.
  bool contradicted = false;
};

// Judges the evidence of now. If only one tenant has sessions in the roll-out, they decide. Of more
// than kMostLeftOut tenants, those with the most sessions are left out in turn, because no other
// has more than a twentieth of the sessions. kFalseAborts is divided by the number of conditions
// (Bonferroni). Of fewer than kFewestNormal sessions (sequential_test.h), returns further than half
// of `trained_range` from the middle of their tenant count as at this end; infinite: of the largest
// distance, by which the probability is not certain.
inline constexpr size_t kMostLeftOut = 20;
RolloutVerdict JudgeRollout(const std::vector<RolloutCondition>& conditions,
                            const VersionEvidence::Counts& new_version,
                            const VersionEvidence::Counts& stable_version, double trained_range);

// How many more sessions (for p99: decisions) of each version a comparison by all conditions needs.
struct Shortfall {
  int64_t new_version = 0;
  int64_t stable_version = 0;

  bool none() const { return new_version == 0 && stable_version == 0; }
};

// Returns what is missing until JudgeRollout() can find the new version worse by any condition.
Shortfall ShortfallOf(const std::vector<RolloutCondition>& conditions,
                      const VersionEvidence::Counts& new_version,
                      const VersionEvidence::Counts& stable_version);

}  // namespace spikeserve
