// What an episode is learned from once its rewards are known: the two local factors of each step,
// from which eq. 4.1 makes the traces. An update is linear in the rewards, but the sums that a
// learner keeps (learner.h) have taken them already.
//
// Plain values; their size grows with the length of the episode. Not thread-safe.
#pragma once

#include <cstdint>
#include <utility>
#include <vector>

namespace spikeserve {

struct StepFactors {
  std::vector<float> post = {};      // [act]: y as answered; empty, as the others: a skipped step
  std::vector<float> executed = {};  // [act]: y of the executed action; empty: as answered
  std::vector<float> readout = {};   // [d]: r

  friend bool operator==(const StepFactors&, const StepFactors&) = default;
};

struct EpisodeFactors {
  std::vector<StepFactors> steps = {};
  std::vector<double> rewards = {};  // that followed each step; of the last one once it has ended

  void Add(double reward_before, StepFactors step) {
    if (!steps.empty()) rewards.push_back(reward_before);
    steps.push_back(std::move(step));
  }
  friend bool operator==(const EpisodeFactors&, const EpisodeFactors&) = default;
};

// An episode that has ended and waits for its verdict.
struct WaitingEpisode {
  int64_t episode = 0;          // index
  EpisodeFactors factors = {};  // `rewards` as received
  bool terminated = false;
  double target_return = 0.0;  // G_0
  double until =
      0.0;  // seconds since 1970 by the clock of the machine; then it is learned as it is

  friend bool operator==(const WaitingEpisode&, const WaitingEpisode&) = default;
};

}  // namespace spikeserve
