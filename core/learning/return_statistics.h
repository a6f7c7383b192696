// mu and sigma of eq. 4.2: mean and deviation of the returns-to-go that really followed, begun
// with those of the training data and carried on online.
//
// Plain values; constant in size whatever the episode's length. Not thread-safe.
#ifndef CORE_LEARNING_RETURN_STATISTICS_H_
#define CORE_LEARNING_RETURN_STATISTICS_H_

#include <cstdint>

namespace spikeserve {

// The rewards before each decision of one episode, c_t = r_0 + ... + r_{t-1}. Once the return R is
// known, so are the returns-to-go: G_t = R - c_t.
struct RewardsBefore {
  int64_t count = 0;     // decisions
  double mean = 0.0;     // of c_t
  double squares = 0.0;  // sum of (c_t - mean)^2, by Welford's recurrence
  double least = 0.0;    // smallest c_t; c_0 = 0
  double most = 0.0;     // largest c_t

  void Add(double rewards);

  friend bool operator==(const RewardsBefore&, const RewardsBefore&) = default;
};

struct ReturnStatistics {
  double mean = 0.0;
  double variance = 1.0;

  // Takes in G_t = episode_return - c_t for every decision of an episode. The past weighs as much
  // as kMemory decisions, so old episodes fade and no count needs to be kept.
  void Merge(const RewardsBefore& rewards, double episode_return);

  // sigma, at least kSmallestDeviation, so that dividing by it is safe where every return is equal.
  double deviation() const;

  // (G - mu) / sigma, eq. 4.2 before its clip.
  double Normalized(double return_to_go) const { return (return_to_go - mean) / deviation(); }

  static constexpr double kMemory = 1000.0;
  static constexpr double kSmallestDeviation = 1e-6;

  friend bool operator==(const ReturnStatistics&, const ReturnStatistics&) = default;
};

}  // namespace spikeserve

#endif  // CORE_LEARNING_RETURN_STATISTICS_H_
