// Defines the end of an episode and its summary. Plain values.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "core/action/action_space.h"
#include "core/learning/contribution.h"

namespace spikeserve {

// The arguments of EndEpisode.
struct EpisodeEnd {
  double reward = 0.0;      // of the last action
  bool terminated = false;  // false: the episode was cut off; see learner.h
  // G_0 of the next episode; absent: the session's default.
  std::optional<double> target_return = std::nullopt;
  // Used only by recordings:
  bool truncated = false;
  std::vector<float> observation = {};  // [obs]: observation after the last action; empty: unknown
  // The executed last action; absent: as answered. Belongs to the action space of the policy.
  std::optional<Action> executed_action = std::nullopt;

  friend bool operator==(const EpisodeEnd&, const EpisodeEnd&) = default;
};

// Returns whether `again` ends an episode as `end` did. An absent executed action says nothing.
inline bool IsSameEnd(const EpisodeEnd& end, EpisodeEnd again) {
  if (!end.executed_action.has_value() || !again.executed_action.has_value()) {
    again.executed_action = end.executed_action;
  }
  return end == again;
}

// The totals of an episode.
struct EpisodeSummary {
  double episode_return = 0.0;
  int64_t steps = 0;
  uint64_t spikes = 0;
  double energy_joules = 0.0;               // estimate; see DefaultEnergy()
  std::optional<LearningSummary> learning;  // absent for a frozen session
  bool awaits_verdict = false;              // `learning` follows with the verdict
};

// The end of an episode and its summary, stored so that a retry gets the same summary.
struct EndedEpisode {
  EpisodeEnd end;
  EpisodeSummary summary;
};

// What a caller says about an episode that has ended.
struct Amendment {
  int64_t episode = 0;
  std::string id;                    // not empty
  std::string digest;                // of all that it says
  std::vector<double> rewards = {};  // in place of those received; empty: as received
  double reward = 0.0;               // added to the last one
};

// What became of an episode that waited for its verdict, stored so that a retry gets the same.
struct Verdict {
  int64_t episode = 0;
  std::string id = {};          // of the amendment; empty: none came in time
  std::string digest = {};      // of the amendment
  double episode_return = 0.0;  // as amended
  std::optional<LearningSummary> learning = {};
};

}  // namespace spikeserve
