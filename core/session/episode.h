// How an episode ends, and what it came to.
#ifndef CORE_SESSION_EPISODE_H_
#define CORE_SESSION_EPISODE_H_

#include <cstdint>
#include <optional>
#include <vector>

#include "core/learning/learning_options.h"
#include "core/learning/return_statistics.h"

namespace spikeserve {

// How an episode ends.
struct EpisodeEnd {
  double reward = 0.0;      // for the last action
  bool terminated = false;  // unless the episode was cut off; see learner.h
  std::optional<double> target_return = std::nullopt;  // G_0 of the next; absent: the session's own
  // For recordings alone.
  bool truncated = false;
  std::vector<float> observation = {};  // [obs], what the last action led to; empty: unknown

  friend bool operator==(const EpisodeEnd&, const EpisodeEnd&) = default;
};

// What a learning session took from an episode.
struct LearningSummary {
  Scope scope = Scope::kSession;
  int64_t updates = 0;          // of the head; scope fleet: gathered for it
  int64_t rejected = 0;         // updates refused as not finite
  double head_drift = 0.0;      // of the head the session plays on
  ReturnStatistics returns;     // mu and sigma^2, the episode taken in
  bool rolled_back = false;     // the guard put back the last good head
  double watched_return = 0.0;  // level of the guard's last window; see return_guard.h
};

struct EpisodeSummary {
  double episode_return = 0.0;
  int64_t steps = 0;
  uint64_t spikes = 0;
  double energy_joules = 0.0;               // estimate, see PrimaryEnergy()
  std::optional<LearningSummary> learning;  // absent for a frozen session
};

// An end and its answer, kept so that a retry gets it again.
struct EndedEpisode {
  EpisodeEnd end;
  EpisodeSummary summary;
};

}  // namespace spikeserve

#endif  // CORE_SESSION_EPISODE_H_
