#include "train/data/dataset.h"

#include <cstddef>

#include "core/math/vector_view.h"

namespace spikeserve {

std::vector<float> ReturnsToGo(const Episode& episode) {
  const std::vector<double>& rewards = episode.rewards;
  std::vector<float> returns(rewards.size());
  double sum = 0.0;
  for (size_t i = rewards.size(); i-- > 0;) {
    sum += rewards[i];
    returns[i] = static_cast<float>(sum);
  }
  if (!episode.target_return.has_value()) return returns;
  double left = *episode.target_return;
  for (size_t i = 0; i < rewards.size(); left -= rewards[i++])
    returns[i] = static_cast<float>(left);
  return returns;
}

Moments ObservationMoments(const Dataset& dataset) {
  constexpr double kSmallestDeviation = 1e-6;
  const auto size = static_cast<size_t>(dataset.observation_size);
  Eigen::ArrayXd sum = Eigen::ArrayXd::Zero(dataset.observation_size);
  Eigen::ArrayXd squares = sum;
  double steps = 0.0;
  for (const Episode& episode : dataset.episodes) {
    const auto observations = AsMatrix(episode.observations, episode.steps() + 1);
    for (int step = 0; step < episode.steps(); ++step) {
      const auto x = observations.row(step).transpose().array().cast<double>();
      sum += x;
      squares += x.square();
    }
    steps += episode.steps();
  }
  const Eigen::ArrayXd mean = sum / steps;
  const Eigen::ArrayXd deviation = (squares / steps - mean.square()).max(0.0).sqrt();
  Moments moments = {.mean = std::vector<float>(size), .std = std::vector<float>(size)};
  AsVector(moments.mean).array() = mean.cast<float>();
  AsVector(moments.std).array() = (deviation + kSmallestDeviation).cast<float>();
  return moments;
}

}  // namespace spikeserve
