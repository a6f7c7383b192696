#include "core/learning/return_guard.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "core/contract/dcheck.h"
#include "core/math/portable.h"

namespace spikeserve {
namespace {

WindowLevel Lower(const WindowLevel& a, const WindowLevel& b) { return a.mean < b.mean ? a : b; }

WindowLevel Mean(const WindowLevel& a, const WindowLevel& b) {
  return {.mean = 0.5 * (a.mean + b.mean), .error = 0.5 * portable::Hypot(a.error, b.error)};
}

}  // namespace

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
  const WindowLevel before = std::exchange(last, InterquartileMean(returns));
  const WindowLevel first_half = InterquartileMean(absl::MakeSpan(returns).first(kWindow / 2));
  returns.clear();
  if (!std::exchange(has_reference, true)) {
    reference = Lower(first_half, last);
    beginning = *delta;
    return false;
  }
  const double allowance =
      margin * std::abs(reference.mean) + kErrors * portable::Hypot(last.error, reference.error);
  const bool bad = last.mean < reference.mean - allowance;
  const bool is_fixed = beginning == *delta;
  if (std::exchange(on_probation, false)) {
    // If others have changed the head meanwhile, the window is no measure of it alone.
    reference = is_fixed ? last : Mean(reference, last);
  } else if (const WindowLevel level = Mean(before, last);
             std::min(last.mean, level.mean) >= reference.mean) {
    good = beginning;
    reference = level;
  }
  const bool restores = bad && !is_fixed;
  if (restores) {
    *delta = good;
    on_probation = true;
    ++rollbacks;
  }
  beginning = *delta;
  return restores;
}

void ReturnGuard::OnRestored(const Eigen::VectorXf& delta) {
  SPIKESERVE_DCHECK_EQ(delta.size(), beginning.size());
  returns.clear();
  beginning = delta;
  good = delta;
  on_probation = has_reference;
}

}  // namespace spikeserve
