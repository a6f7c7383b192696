// mu and sigma of eq. 4.2: mean and deviation of the returns that really followed, carried on
// online.
//
// Plain values; constant in size whatever the episode's length. Not thread-safe.
#ifndef CORE_LEARNING_RETURN_STATISTICS_H_
#define CORE_LEARNING_RETURN_STATISTICS_H_

#include <cstdint>

namespace spikeserve {

// Sums over the returns that followed each decision t of one episode, discounted by gamma:
//   G_t = sum_{k >= t} gamma^{k-t} r_k
// A reward adds gamma^{k-t} r_k to every G_t at once, so the sums of G_t and of G_t^2 follow from
// four numbers, and no G_t is kept.
struct EpisodeReturns {
  int64_t decisions = 0;
  double rewards = 0.0;    // sum_k r_k
  double returns = 0.0;    // sum_t G_t of the rewards so far
  double squares = 0.0;    // sum_t G_t^2
  double weights = 0.0;    // sum_t gamma^{k-t}, k the last decision
  double weights2 = 0.0;   // sum_t gamma^{2(k-t)}
  double projected = 0.0;  // sum_t gamma^{k-t} G_t

  // Another decision.
  void AddDecision(double discount);
  // A reward for the last decision; several add up.
  void AddReward(double reward);

  // Over the decisions. REQUIRES: there were some.
  double mean() const { return returns / static_cast<double>(decisions); }
  // Mean of (G_t - centre)^2, at least 0.
  double SquaresAbout(double centre) const;
  double mean_reward() const { return rewards / static_cast<double>(decisions); }

  friend bool operator==(const EpisodeReturns&, const EpisodeReturns&) = default;
};

struct ReturnStatistics {
  double mean = 0.0;
  double variance = 1.0;
  double decisions = 0.0;  // how many these stand for, at most kMemory; 0: nothing is known yet

  // Takes in G_t for every decision of an episode. The past never weighs more than kMemory
  // decisions, so old episodes fade.
  void Merge(const EpisodeReturns& episode);

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
