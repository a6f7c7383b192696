#include "core/learning/return_guard.h"

#include <algorithm>
#include <cmath>

#include "core/contract/dcheck.h"
#include "core/math/portable.h"

namespace spikeserve {

WindowLevel InterquartileMean(absl::Span<const double> values) {
  SPIKESERVE_DCHECK_GE(values.size(), size_t{4});
  std::vector<double> sorted(values.begin(), values.end());
  std::sort(sorted.begin(), sorted.end());
  const size_t quarter = sorted.size() / 4;
  const size_t end = sorted.size() - quarter;
  const auto middle = static_cast<double>(end - quarter);
  const auto count = static_cast<double>(sorted.size());

  WindowLevel level;
  for (size_t i = quarter; i < end; ++i) level.mean += sorted[i] / middle;
  // The error follows from the deviation of the winsorised values, in which the values of the outer
  // quarters are replaced by the quartiles.
  double mean = 0.0;
  for (double& value : sorted) {
    value = std::clamp(value, sorted[quarter], sorted[end - 1]);
    mean += value / count;
  }
  double squares = 0.0;
  for (const double value : sorted) squares += (value - mean) * (value - mean);
  level.error = std::sqrt(squares / (count - 1.0)) / (middle / count * std::sqrt(count));
  return level;
}

ReturnGuard ReturnGuard::New(const Eigen::VectorXf& delta) {
  ReturnGuard guard;
  guard.beginning = delta;
  guard.good = delta;
  return guard;
}

bool ReturnGuard::OnEpisode(double episode_return, double margin, Eigen::VectorXf* delta) {
  SPIKESERVE_DCHECK_EQ(delta->size(), beginning.size());
  returns.push_back(episode_return);
  if (returns.size() < kWindow) return false;
  last = InterquartileMean(returns);
  returns.clear();
  const double allowance =
      margin * std::abs(reference.mean) + kErrors * portable::Hypot(last.error, reference.error);
  const bool bad = has_reference && last.mean < reference.mean - allowance;
  if (bad) {
    RollBack(delta);
  } else {
    good = beginning;
    on_probation = false;
    if (!has_reference || last.mean > reference.mean) reference = last;
    has_reference = true;
  }
  beginning = *delta;
  return bad;
}

void ReturnGuard::OnRestored(const Eigen::VectorXf& delta) {
  SPIKESERVE_DCHECK_EQ(delta.size(), beginning.size());
  returns.clear();
  beginning = delta;
  good = delta;
}

void ReturnGuard::RollBack(Eigen::VectorXf* delta) {
  if (on_probation) {
    good.setZero();
    has_reference = false;
  }
  on_probation = !on_probation;
  *delta = good;
  ++rollbacks;
}

}  // namespace spikeserve
