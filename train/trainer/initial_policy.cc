#include "train/trainer/initial_policy.h"

#include <algorithm>
#include <cmath>
#include <tuple>
#include <utility>

#include "core/math/vector_view.h"
#include "train/trainer/return_scaling.h"

namespace spikeserve {
namespace {

// Returns the mean and standard deviation of the returns-to-go: mu and sigma of eq. 4.2.
std::pair<float, float> ReturnMoments(const Dataset& dataset) {
  double sum = 0.0, squares = 0.0, count = 0.0;
  for (const Episode& episode : dataset.episodes) {
    const Eigen::VectorXd returns = AsVector(ReturnsToGo(episode)).cast<double>();
    sum += returns.sum();
    squares += returns.squaredNorm();
    count += static_cast<double>(returns.size());
  }
  const double mean = sum / count;
  const double deviation = std::sqrt(std::max(1e-6, squares / count - mean * mean));
  return {static_cast<float>(mean), static_cast<float>(deviation)};
}

// Returns the scaling of the dataset's environment. For an environment without one, returns
// `moments` and the best return in the data.
ReturnScaling ScalingOf(const Dataset& dataset, const std::pair<float, float>& moments) {
  if (const auto scaling = ReturnScalingOf(dataset.environment); scaling.ok()) return *scaling;
  float best = ReturnsToGo(dataset.episodes[0])[0];
  for (const Episode& episode : dataset.episodes) {
    best = std::max(best, ReturnsToGo(episode)[0]);
  }
  return {.offset = moments.first, .scale = moments.second, .target = best};
}

}  // namespace

Policy InitialPolicy(const ModelConfig& config, const Dataset& dataset, uint64_t seed) {
  Policy policy = RandomPolicy(config, dataset.observation_size, dataset.action_space, seed);
  const std::pair<float, float> return_moments = ReturnMoments(dataset);
  const ReturnScaling returns = ScalingOf(dataset, return_moments);
  const Moments moments = ObservationMoments(dataset);
  policy.weights.observation_mean.values = moments.mean;
  policy.weights.observation_std.values = moments.std;
  policy.return_offset = returns.offset;
  policy.return_scale = returns.scale;
  policy.target_return = returns.target;
  std::tie(policy.modulator_mean, policy.modulator_std) = return_moments;
  policy.environment = dataset.environment;
  return policy;
}

}  // namespace spikeserve
