#include "core/learning/head_update.h"

#include <cmath>
#include <utility>

#include "core/learning/eligibility_trace.h"

namespace spikeserve {

UpdateOutcome ApplyUpdate(double factor, absl::Span<const double> direction,
                          const UpdateBounds& bounds, std::vector<float>* delta) {
  double squares = 0.0;
  for (const double value : direction) squares += value * value;
  const double norm = std::abs(factor) * std::sqrt(squares);
  if (!std::isfinite(norm)) return UpdateOutcome::kNonFinite;
  if (norm > bounds.clip) factor *= bounds.clip / norm;

  std::vector<float> next = *delta;
  for (size_t i = 0; i < next.size(); ++i) {
    next[i] = static_cast<float>(next[i] + factor * direction[i]);
  }
  const double drift = FrobeniusNorm(next);
  if (!std::isfinite(drift)) return UpdateOutcome::kNonFinite;
  if (drift > bounds.max_norm) {
    const double shrink = bounds.max_norm / drift;
    for (float& value : next) value = static_cast<float>(value * shrink);
  }
  *delta = std::move(next);
  return UpdateOutcome::kApplied;
}

}  // namespace spikeserve
