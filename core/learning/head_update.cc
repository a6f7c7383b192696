#include "core/learning/head_update.h"

#include <cmath>

#include "core/contract/dcheck.h"
#include "core/learning/frobenius_norm.h"

namespace spikeserve {
namespace {

template <typename Direction>
UpdateOutcome Apply(double factor, const Direction& direction, const UpdateBounds& bounds,
                    Eigen::VectorXf* delta) {
  SPIKESERVE_DCHECK_EQ(direction.size(), delta->size());
  SPIKESERVE_DCHECK_LE(bounds.max_norm, kLongestHeadDelta);
  const double norm = std::abs(factor) * FrobeniusNorm(direction);
  if (!std::isfinite(norm)) return UpdateOutcome::kNonFinite;
  if (norm > bounds.clip) factor *= bounds.clip / norm;

  // `auto` keeps the unevaluated expression, so that the step is checked before `delta` changes and
  // without a copy of it.
  const auto next =
      (delta->cast<double>() + factor * direction.template cast<double>()).template cast<float>();
  const double drift = FrobeniusNorm(next);
  if (!std::isfinite(drift)) return UpdateOutcome::kNonFinite;
  *delta = next;
  if (drift > bounds.max_norm) {
    *delta = (delta->cast<double>() * (bounds.max_norm / drift)).cast<float>();
  }
  return UpdateOutcome::kApplied;
}

}  // namespace

UpdateOutcome ApplyUpdate(double factor, const Eigen::VectorXf& direction,
                          const UpdateBounds& bounds, Eigen::VectorXf* delta) {
  return Apply(factor, direction, bounds, delta);
}

UpdateOutcome ApplyUpdate(double factor, const Eigen::VectorXd& direction,
                          const UpdateBounds& bounds, Eigen::VectorXf* delta) {
  return Apply(factor, direction, bounds, delta);
}

}  // namespace spikeserve
