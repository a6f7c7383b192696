#include "train/data/dataset.h"

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace spikeserve {

std::vector<float> ReturnsToGo(const Episode& episode) {
  const std::vector<double>& rewards = episode.rewards;
  std::vector<float> returns(rewards.size());
  double sum = 0.0;
  for (size_t i = rewards.size(); i-- > 0;) {
    sum += rewards[i];
    returns[i] = static_cast<float>(sum);
  }
  if (!episode.asked_return.has_value()) return returns;
  double left = *episode.asked_return;
  for (size_t i = 0; i < rewards.size(); left -= rewards[i++])
    returns[i] = static_cast<float>(left);
  return returns;
}

Moments ObservationMoments(const Dataset& dataset) {
  constexpr double kSmallestDeviation = 1e-6;
  const size_t size = dataset.observation_size;
  std::vector<double> sum(size), squares(size);
  double steps = 0.0;
  for (const Episode& episode : dataset.episodes) {
    for (size_t i = 0; i < episode.actions.size() * size; ++i) {
      const double x = episode.observations[i];
      sum[i % size] += x;
      squares[i % size] += x * x;
    }
    steps += episode.steps();
  }
  Moments moments;
  for (size_t i = 0; i < size; ++i) {
    const double mean = sum[i] / steps;
    const double variance = std::max(0.0, squares[i] / steps - mean * mean);
    moments.mean.push_back(static_cast<float>(mean));
    moments.std.push_back(static_cast<float>(std::sqrt(variance) + kSmallestDeviation));
  }
  return moments;
}

}  // namespace spikeserve
