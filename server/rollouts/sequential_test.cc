#include "server/rollouts/sequential_test.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>

#include "core/math/portable.h"

namespace spikeserve {
namespace {

// Scale of the effects that the test looks for, in standard deviations of one observation.
constexpr double kEffect = 0.5;

// The stakes of the bets, as parts of the largest one that cannot lose more than there is. Each
// gets the same share of the money.
constexpr std::array<double, 6> kStakes = {0.5, 0.25, 0.125, 0.0625, 0.03125, 0.015625};
constexpr int kMeans = 100;  // values of the mean that are tried

// Returns the logarithm of what bets have won that the mean of the values, or of 1 minus the values
// if they are `mirrored`, is above `mean`, which is above 0. Falls with `mean`.
double LogBets(absl::Span<const ObservedValue> observations, double mean, bool mirrored) {
  std::array<double, kStakes.size()> logs = {};
  for (size_t i = 0; i < kStakes.size(); ++i) {
    for (const ObservedValue& observed : observations) {
      const double value = mirrored ? 1.0 - observed.value : observed.value;
      logs[i] += static_cast<double>(observed.count) *
                 portable::Log(1.0 + kStakes[i] * (value - mean) / mean);
    }
  }
  const double most = *std::max_element(logs.begin(), logs.end());
  double sum = 0.0;
  for (const double log : logs) sum += portable::Exp(log - most);
  return most + portable::Log(sum / static_cast<double>(kStakes.size()));
}

}  // namespace

double LogWorseRatio(const Comparison& comparison, double scale) {
  if (std::min(comparison.new_count, comparison.stable_count) < kFewestObservations) {
    return -std::numeric_limits<double>::infinity();
  }
  const auto new_count = static_cast<double>(comparison.new_count);
  const auto stable_count = static_cast<double>(comparison.stable_count);
  // Welch's variance of the difference of two means, and its variance if one observation had
  // variance 1.
  const double variance =
      comparison.new_variance / new_count + comparison.stable_variance / stable_count;
  const double unit = 1.0 / new_count + 1.0 / stable_count;
  const double least = 1e-6 * scale * scale;
  const double deviation =
      std::sqrt(std::max({variance / unit, least, std::numeric_limits<double>::min()}));
  const double effect = comparison.difference / deviation;
  // The integral of the likelihood ratio over the half-normal mixture, in closed form.
  const double total = unit + kEffect * kEffect;
  const double z = effect * kEffect / std::sqrt(unit * total);
  return std::numbers::ln2 + 0.5 * portable::Log(unit / total) + 0.5 * z * z +
         portable::LogNormalDistribution(z);
}

double LogBettingRatio(absl::Span<const ObservedValue> fresh,
                       absl::Span<const ObservedValue> stable, double margin) {
  if (fresh.empty() || stable.empty()) return 0.0;
  // If the new version is not worse, its mean is at least m - margin and the stable one's at most
  // m, for some m. Between two values of m, the bets have won at least what the first one wins with
  // the lower mean of `fresh` and the second one with the higher mean of `stable`.
  double least = std::numeric_limits<double>::infinity();
  for (int i = 0; i < kMeans; ++i) {
    const double low = std::max(static_cast<double>(i) / kMeans - margin, 0.0);
    const double high = static_cast<double>(i + 1) / kMeans;
    least = std::min(least, LogBets(fresh, 1.0 - low, /*mirrored=*/true) +
                                LogBets(stable, high, /*mirrored=*/false));
  }
  return least;
}

}  // namespace spikeserve
