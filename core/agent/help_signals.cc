#include "core/agent/help_signals.h"

#include <algorithm>

#include "absl/types/span.h"
#include "core/math/portable.h"

namespace spikeserve {
namespace {

// Returns the entropy of `probabilities` as a share of the largest possible one.
double EntropyShare(absl::Span<const float> probabilities) {
  if (probabilities.size() < 2) return 0.0;
  double entropy = 0.0;
  for (const float each : probabilities) {
    const auto p = static_cast<double>(each);
    if (p > 0.0) entropy -= p * portable::Log(p);
  }
  return std::clamp(entropy / portable::Log(static_cast<double>(probabilities.size())), 0.0, 1.0);
}

}  // namespace

void HelpSignals::OnDecision(const Answer& answer) {
  // The mean of the first ones, so that a session that begins badly is seen at once.
  decisions_ = std::min(decisions_ + 1, kMemory);
  const double weight = 1.0 / static_cast<double>(decisions_);
  unusual_ += weight * ((answer.unusual_observations > 0 ? 1.0 : 0.0) - unusual_);
  entropy_ += weight * (EntropyShare(answer.probabilities) - entropy_);
}

void HelpSignals::OnReport(const BeatCounts& added) {
  const uint64_t fallbacks = added.held + added.local + added.safe;
  const uint64_t beats = fallbacks + added.fresh;
  if (beats > 0) fallbacks_ = static_cast<double>(fallbacks) / static_cast<double>(beats);
}

Help HelpSignals::Now(double lacking, double range) const {
  return {.unusual_observations = unusual_,
          .entropy = entropy_,
          .low_return = std::clamp(std::max(lacking, lacking_) / range, 0.0, 1.0),
          .fallbacks = fallbacks_};
}

}  // namespace spikeserve
