// One request of a robot to its session: the steps that the session may not have, the step that is
// to be decided or the end of the episode, and the result. A server converts a request to a Step
// once, and AgentSession::Apply() does the rest. A player in the same process makes Steps itself.
//
//   Step step = {.session = &agent, .observation = observation, .reward = 0.5};
//   AgentSession::Apply({&step});
//   if (step.result.status.ok()) Execute(step.result.answer->action);
//
// Plain values with views of the request, which must outlive them. Not thread-safe.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>

#include "absl/status/status.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "core/action/reported_action.h"
#include "core/agent/robot_link.h"
#include "core/session/session.h"

namespace spikeserve {

class AgentSession;

// Where a request belongs, as far as it says so.
struct Place {
  std::optional<int64_t> episode = std::nullopt;    // that the request ends
  std::optional<uint64_t> decision = std::nullopt;  // decisions of the session before the request
  // Decisions of the episode before the request. Absent: the next step, so that it is no retry.
  std::optional<int64_t> step = std::nullopt;

  // Returns whether the request names its place in the session and not only in its episode, so that
  // a copy of the session that may answer it is the newest one.
  bool is_of_session() const {
    return decision.has_value() || (episode.has_value() && step.has_value());
  }
};

// A step that the robot took without an answer of the server.
struct PastStep {
  int64_t step = 0;                     // within the episode
  absl::Span<const float> observation;  // empty: the robot had no valid one
  double reward = 0.0;                  // of the action before
  ReportedAction executed;              // at this step, and who chose it
  bool has_reward = true;               // false: it was left out, and `reward` is 0
};

// Past steps in a form of the caller's, which are converted one by one when they are read.
struct PastSteps {
  size_t size = 0;
  const void* source = nullptr;
  PastStep (*read)(const void* source, size_t i) = nullptr;

  PastStep operator[](size_t i) const { return read(source, i); }
};

// The times of a request, and what its robot reports.
struct StepTimes {
  RobotLink* link = nullptr;                       // of the session
  absl::Duration received;                         // by the server's clock
  std::optional<absl::Duration> observed_at = {};  // by the robot's clock
  std::optional<absl::Duration> valid_until = {};  // by the robot's clock
  std::optional<BeatCounts> report = {};           // absent: no news
  bool is_new_session = true;  // false: the session was taken over from another server
};

// What became of a step so far. A long history is taken in several parts.
struct StepOutcome {
  // Errors leave the session as it was, but for the past steps that were taken before them.
  absl::Status status;
  // Valid until the session changes. Null: no decision was asked for, or it came too late.
  const Answer* answer = nullptr;
  // Of the episode that the step has ended; absent: it ends none, or a restored session has
  // forgotten the summary.
  std::optional<EpisodeSummary> summary = std::nullopt;
  bool is_retry = false;  // the answer, or the summary, is the stored one

  int64_t appended = 0;  // past steps that were taken with their observations
  int64_t dropped = 0;   // past steps of which only the rewards were counted
  absl::Duration spent;  // on the past steps
  absl::Duration begun;  // when the decision or the end began, if there are times or past steps
  bool expired = false;  // nothing was decided, because the answer would have come too late
  bool finished = true;  // false: another part of the history is to be taken

  // Of Apply(), between its calls: the times are taken, the history is checked.
  bool started = false;
  bool checked = false;
  // Of Apply(): the action that was executed at the step before, checked.
  std::optional<Action> executed = std::nullopt;
};

struct Step {
  AgentSession* session = nullptr;
  Place place = {};

  // Rewards of the steps before `history`, whose observations are not known, oldest first.
  absl::Span<const double> skipped_rewards = {};
  PastSteps history = {};  // the steps directly before this one, without a gap

  absl::Span<const float> observation = {};  // empty: no decision is asked for
  double reward = 0.0;                       // of the action before
  bool has_reward = true;                    // false: it was left out, and `reward` is 0
  // At the step before, and who chose it; absent: as answered. Not used directly behind a gap.
  std::optional<ReportedAction> executed = std::nullopt;

  // Ends the episode behind the history; `executed` is then its last action.
  std::optional<EpisodeEnd> end = std::nullopt;
  std::optional<StepTimes> times = std::nullopt;
  bool is_past = false;  // of Apply(): nobody asked for the decision

  StepOutcome result = {};

  bool has_past() const { return history.size > 0 || !skipped_rewards.empty(); }
};

// The most past steps of one request that are taken with their observations; of longer histories
// the older ones are dropped. A robot that has more sends them in several requests.
inline constexpr int64_t kHistoryLimit = 1024;

// The most skipped rewards of one request.
inline constexpr int64_t kMostSkippedRewards = 65536;

// How many past steps a group of requests may take.
inline constexpr int64_t kPastStepsPerGroup = 32;

// What several calls of Apply() may take of histories together, so that requests without one wait
// for as little as if there were one with.
struct StepBudget {
  int64_t steps = kPastStepsPerGroup;
  absl::Duration until = absl::InfiniteDuration();  // time of the clock
};

}  // namespace spikeserve
