#include "core/learning/return_statistics.h"

#include <algorithm>
#include <cmath>

namespace spikeserve {

void RewardsBefore::Add(double rewards) {
  ++count;
  const double difference = rewards - mean;
  mean += difference / static_cast<double>(count);
  squares += difference * (rewards - mean);
  least = std::min(least, rewards);
  most = std::max(most, rewards);
}

void ReturnStatistics::Merge(const RewardsBefore& rewards, double episode_return) {
  if (rewards.count == 0) return;
  const auto count = static_cast<double>(rewards.count);
  const double weight = count / (count + kMemory);
  const double difference = (episode_return - rewards.mean) - mean;
  variance = (1.0 - weight) * variance + weight * (rewards.squares / count) +
             weight * (1.0 - weight) * difference * difference;
  mean += weight * difference;
}

double ReturnStatistics::deviation() const {
  return std::max(std::sqrt(variance), kSmallestDeviation);
}

}  // namespace spikeserve
