#include "core/learning/return_statistics.h"

#include <algorithm>
#include <cmath>

#include "core/contract/dcheck.h"

namespace spikeserve {

void EpisodeReturns::AddDecision(double discount) {
  ++decisions;
  weights = discount * weights + 1.0;
  weights2 = discount * discount * weights2 + 1.0;
  projected *= discount;
}

void EpisodeReturns::AddGap(double discount) {
  weights *= discount;
  weights2 *= discount * discount;
  projected *= discount;
}

void EpisodeReturns::AddReward(double reward) {
  rewards += reward;
  returns += reward * weights;
  squares += 2.0 * reward * projected + reward * reward * weights2;
  projected += reward * weights2;
}

double EpisodeReturns::SquaresAbout(double centre) const {
  SPIKESERVE_DCHECK_GT(decisions, 0);
  const double about_zero = squares / static_cast<double>(decisions);
  return std::max(0.0, about_zero - centre * (2.0 * mean() - centre));
}

void ReturnStatistics::Merge(const EpisodeReturns& episode) {
  if (episode.decisions == 0) return;
  const auto count = static_cast<double>(episode.decisions);
  const double weight = count / (count + decisions);
  const double difference = episode.mean() - mean;
  variance = (1.0 - weight) * variance + weight * episode.SquaresAbout(episode.mean()) +
             weight * (1.0 - weight) * difference * difference;
  mean += weight * difference;
  decisions = std::min(decisions + count, kMemory);
}

double ReturnStatistics::deviation() const {
  return std::max(std::sqrt(variance), kSmallestDeviation);
}

}  // namespace spikeserve
