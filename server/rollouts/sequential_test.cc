#include "server/rollouts/sequential_test.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

#include "core/math/portable.h"

namespace spikeserve {
namespace {

// Scale of the effects that the test looks for, in standard deviations of one observation.
constexpr double kEffect = 0.5;

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

}  // namespace spikeserve
