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
  const bool bad = IsBad(last, margin);
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

bool ReturnGuard::IsBad(const WindowLevel& level, double margin) const {
  const double allowance =
      margin * std::abs(reference.mean) + kErrors * portable::Hypot(level.error, reference.error);
  return level.mean < reference.mean - allowance;
}

void ReturnGuard::OnTaught(const Eigen::VectorXf& delta) {
  SPIKESERVE_DCHECK_EQ(delta.size(), beginning.size());
  if (returns.size() >= kAlone) return Settle(delta);
  // Too few to judge the head before. Those of heads that are taught on and on are one window, so
  // that nobody keeps them from being judged by teaching a little now and then.
  if (std::exchange(on_probation, false) || delta == good) returns.clear();
}

bool ReturnGuard::OnEpisodeAlone(double episode_return, double margin, Eigen::VectorXf* delta) {
  SPIKESERVE_DCHECK_EQ(delta->size(), beginning.size());
  returns.push_back(episode_return);
  if (returns.size() != kAlone && returns.size() != kWindow) return false;
  const WindowLevel level = InterquartileMean(returns);
  const bool was_on_trial = std::exchange(on_probation, false);
  const bool fails = was_on_trial ? level.mean < last.mean
                                  : has_reference && *delta != good && IsBad(level, margin);
  if (was_on_trial) {
    if (fails) *delta = good = beginning;
    if (!fails) last = level;
    reference = last;
  } else if (fails) {
    beginning = std::exchange(*delta, good);
    last = level;
    on_probation = true;
  } else {
    if (returns.size() == kWindow) Settle(*delta);
    return false;
  }
  returns.clear();
  rollbacks += fails ? 1 : 0;
  return fails;
}

void ReturnGuard::Settle(const Eigen::VectorXf& delta) {
  last = InterquartileMean(returns);
  returns.clear();
  if (has_reference && delta != good && last.mean < reference.mean) return;
  has_reference = true;
  good = delta;
  reference = last;
}

void ReturnGuard::OnRestored(const Eigen::VectorXf& delta) {
  SPIKESERVE_DCHECK_EQ(delta.size(), beginning.size());
  returns.clear();
  beginning = delta;
  good = delta;
  on_probation = has_reference;
}

}  // namespace spikeserve
