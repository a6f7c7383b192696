// mu and sigma of eq. 4.2: a running mean and deviation of the returns that followed the decisions.
//
// Plain values; their size does not depend on the length of the episode. Not thread-safe.
#pragma once

#include <cstdint>

namespace spikeserve {

// Sums of the discounted returns that followed the decisions t of one episode:
//   G_t = sum_{k >= t} gamma^{k-t} r_k
// The reward r_k adds gamma^{k-t} r_k to every G_t with t <= k. The sums of G_t and of G_t^2
// therefore need only the numbers below, and no G_t is stored. k is the last decision.
struct EpisodeReturns {
  int64_t decisions = 0;
  double rewards = 0.0;    // sum_t r_t
  double returns = 0.0;    // sum_t G_t, from the rewards so far
  double squares = 0.0;    // sum_t G_t^2
  double weights = 0.0;    // sum_t gamma^{k-t}
  double weights2 = 0.0;   // sum_t gamma^{2(k-t)}
  double projected = 0.0;  // sum_t gamma^{k-t} G_t

  // Adds a decision; its reward is zero until AddReward.
  void AddDecision(double discount);
  // Adds a step without a decision, between two decisions; its reward is zero until AddReward.
  void AddGap(double discount);
  // Adds a reward of the last decision. Several rewards of one decision add up.
  void AddReward(double reward);

  // Mean of G_t over the decisions. REQUIRES: decisions > 0, as for all that follow.
  double mean() const { return returns / static_cast<double>(decisions); }
  // Mean of (G_t - centre)^2, at least 0.
  double SquaresAbout(double centre) const;
  double mean_reward() const { return rewards / static_cast<double>(decisions); }

  friend bool operator==(const EpisodeReturns&, const EpisodeReturns&) = default;
};

struct ReturnStatistics {
  double mean = 0.0;
  double variance = 1.0;
  double decisions = 0.0;  // weight of both, in decisions, at most kMemory; 0: nothing is known

  // Adds the G_t of every decision of an episode. What came before counts as at most kMemory
  // decisions, so the influence of old episodes decays.
  void Merge(const EpisodeReturns& episode);

  // Returns sigma, at least kSmallestDeviation, so that a division by it is safe if all returns are
  // equal.
  double deviation() const;

  // Returns (G - mu) / sigma, which is eq. 4.2 before its clip.
  double Normalized(double return_to_go) const { return (return_to_go - mean) / deviation(); }

  static constexpr double kMemory = 1000.0;
  static constexpr double kSmallestDeviation = 1e-6;

  friend bool operator==(const ReturnStatistics&, const ReturnStatistics&) = default;
};

}  // namespace spikeserve
