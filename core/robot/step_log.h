// The control steps of the robot that the server may not have. Nothing here waits.
//
// Steps are numbered from 0, over all episodes of the robot, and the last ones are kept in a ring:
// their observations, their executed actions, and for a longer time their rewards. A history begins
// one step before the one that the server expects, with what was executed there, or the server's
// context starts behind a gap. So nothing is lost and nothing is counted twice, whatever the link
// does. The memory is reserved once, and touched as it is needed.
//
// The server's session is at the oldest episode, or at the one after it if the answer to the end of
// the oldest one is under way or lost. So at most one end is under way: the server repeats the
// answer to the last end only.
//
// Not thread-safe.
#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/robot/action_shape.h"
#include "core/robot/counters.h"
#include "core/robot/time.h"

namespace spikeserve::robot {

// A step in the log, until the next call that changes it.
struct StepView {
  std::span<const float> observation;  // empty: the robot had no valid one
  double reward = 0.0;                 // for the action before
  ActionView executed;                 // of the newest step: what was executed so far, if anything
  ChooserView chooser;                 // of `executed`
};

// A step outside the ring.
struct KeptStep {
  std::vector<float> observation;
  double reward = 0.0;
  ActionValue executed;
  ChooserValue chooser;
};

// How an episode has ended, in the terms of Gymnasium.
struct Outcome {
  double reward = 0.0;  // for the last action
  bool terminated = false;
  bool truncated = false;
  std::optional<double> target_return = std::nullopt;  // of the next episode
  std::vector<float> observation = {};                 // after the last action; may be empty
};

enum class EpisodeState {
  kRunning,  // steps are added at the robot
  kEnded,    // the robot has ended it; the server misses steps, or its end, or an older one
  kEnding,   // its end is under way; requests are of the episode after it
  kSettled,  // the server has answered the end, and its store may lose it: then it is kEnded again
};

struct Episode {
  EpisodeState state = EpisodeState::kRunning;
  uint64_t serial = 0;  // counts the episodes of the robot
  int64_t index = 0;    // in the server's session
  uint64_t first = 0;   // number of its first step
  uint64_t steps = 0;
  uint64_t lost_steps = 0;  // before the first one, which only a lost session had
  double rewards = 0.0;     // sum for the steps behind the first one, which has no action before
  Outcome outcome = {};
  // Of an ended episode, the last two steps, or one if there is no other, which outlast the ring:
  // the end needs the last one, and its place in the session needs the one before.
  std::vector<KeptStep> last = {};

  uint64_t past() const { return first + steps; }
  bool has_ended() const { return state != EpisodeState::kRunning; }
  // Returns the return of an ended episode, added in the order of the server.
  double episode_return() const { return rewards + outcome.reward; }
};

// What a request has, until the log changes. The steps are numbers in the log.
struct Request {
  const Episode* episode = nullptr;
  uint64_t decision = 0;              // of the server's session, the place of step `end`
  uint64_t skipped = 0;               // the rewards of [skipped, begin) are sent alone
  uint64_t begin = 0, end = 0;        // the history is [begin, end)
  bool asks = false;                  // for a decision for step `end`, whose observation is sent
  bool ends = false;                  // the episode, behind the history
  Time observed_at = kLongAgo;        // of step `end`, by the robot's clock
  std::string_view traceparent = {};  // of step `end`
  std::optional<Report> report = std::nullopt;

  int64_t step() const { return static_cast<int64_t>(end - episode->first); }
};

class StepLog {
 public:
  // Keeps `kept` steps, at least 2, that the server may miss, and one before them, with
  // `observation_size` numbers each.
  StepLog(size_t kept, size_t observation_size, const ActionShape& shape);

  const ActionShape& shape() const { return shape_; }
  // The episode of the robot's next step, and the one that the server's session is at.
  const Episode& running() const { return episodes_.back(); }
  const Episode& oldest() const { return episodes_[settled_]; }
  // Returns the one that the next request is of: the oldest one until its end is under way.
  const Episode& asked() const { return episodes_[settled_ + (is_ending() ? 1U : 0U)]; }
  // Returns whether the next request is of the running episode.
  bool is_current() const { return &asked() == &running(); }
  // Returns whether the next request would be, after one that ends the oldest episode.
  bool is_one_behind() const;
  bool is_ending() const { return oldest().state == EpisodeState::kEnding; }
  // Returns the episode with an index in the server's session whose end is not settled, or null.
  const Episode* Find(int64_t index) const;
  // Returns whether the server has all steps of the oldest episode, which has ended.
  bool is_complete() const { return oldest().has_ended() && acknowledged_ >= oldest().past(); }
  // Returns whether the server has missed so much that its session has to be given up.
  bool is_too_long() const;
  // Returns the number of the next step.
  uint64_t next() const { return next_; }

  // Adds a step to the running episode, with an empty `observation` if there is no valid one.
  // `observed_at` is by the robot's clock, `traceparent` the trace context of the step. Returns its
  // number.
  uint64_t Add(std::span<const float> observation, double reward, Time observed_at,
               std::string_view traceparent = "");
  // Sets what the robot has executed in the last step, and who chose it. REQUIRES: there is one;
  // the name of the operator has at most kLongestOperatorId bytes.
  void SetExecuted(const ActionView& action, const ChooserView& chooser = {});
  // Ends the running episode, which has a step. The next step begins another one. Returns its
  // serial number.
  uint64_t End(Outcome outcome);

  // Returns whether what is known of the step `number` is kept.
  bool Has(uint64_t number) const { return number >= kept_from() && number < next_; }
  // REQUIRES: Has(number).
  StepView At(uint64_t number) const;
  // As At, also for the last steps of an ended episode.
  StepView StepOf(const Episode& episode, uint64_t number) const;
  double RewardOf(uint64_t number) const { return rewards_[number % reward_slots_]; }
  // Returns the number of the step that is the decision `decision` of the server's session.
  uint64_t NumberOf(uint64_t decision) const { return decision + base_; }

  // Returns the request for the newest step of asked(), with the steps that the server may miss. If
  // there are more of them than fit, or this episode has ended, it asks for no decision and carries
  // the oldest ones.
  Request NextRequest() const;
  // Returns whether it surely fits into a datagram.
  bool FitsDatagram() const;
  // Returns whether it carries all of them.
  bool FitsOne() const { return HistoryPast() - HistoryBegin() <= most(); }

  // Notes that the end of the oldest episode is under way, behind all of its steps, or that it is
  // not any more.
  void BeginEnd() { episodes_[settled_].state = EpisodeState::kEnding; }
  void AbandonEnd() {
    if (is_ending()) episodes_[settled_].state = EpisodeState::kEnded;
  }
  // Notes that the server expects step `next_step` of the oldest episode.
  void Acknowledge(int64_t next_step);
  // Notes that the server expects an older decision, which is of `episode` if that is known.
  // Returns false if its step is not kept.
  bool Rewind(uint64_t decision, std::optional<int64_t> episode);
  // Notes that the end of the oldest episode was answered. With `is_stored`, keeps the episode
  // until the store has the end.
  void Settle(bool is_stored);
  // Notes that the store has so many decisions, and the ends of so many episodes. A server of an
  // earlier release does not name the ends; they are in front of the decisions behind them.
  void ForgetDurable(uint64_t decisions, int64_t episodes);
  // Moves to a new session, whose first episode has the rewards of the running one, and its steps
  // as far as they are kept; or begins with the next step, if the server has refused them. The
  // ended episodes are lost.
  void BeginAgain(bool keeps_steps = true);

  // The most steps of one history that the server appends with their observations.
  void set_history_limit(int64_t limit) { history_limit_ = static_cast<uint64_t>(limit); }
  // Returns the number of steps whose observations were not kept until the server had them.
  uint64_t dropped() const { return dropped_; }
  uint64_t lost_episodes() const { return lost_episodes_; }

 private:
  uint64_t kept_from() const;
  uint64_t kept_from(const Episode& episode) const;  // with its end
  uint64_t rewards_from() const;
  size_t SlotOf(uint64_t number) const { return number % kept_; }
  ChooserView ChooserOf(size_t slot) const;
  // Returns the most steps of one history.
  uint64_t most() const;
  // Returns the number of the first step in the next request's history, and that behind its last.
  uint64_t HistoryBegin() const;
  uint64_t HistoryPast() const { return asked().past() - (asked().has_ended() ? 0 : 1); }

  const size_t kept_;
  const size_t reward_slots_;
  const size_t observation_size_;
  const ActionShape shape_;
  const std::unique_ptr<float[]> observations_;  // [kept, observation_size]
  const std::unique_ptr<float[]> continuous_;    // [kept, shape.size()]: executed actions
  const std::unique_ptr<int64_t[]> discrete_;    // [kept]: executed actions
  const std::unique_ptr<Chooser[]> choosers_;    // [kept]: of executed actions
  // [kept, 1 + kLongestOperatorId]: the size of an operator's name, and the name. Used for
  // operators only.
  const std::unique_ptr<char[]> operators_;
  const std::unique_ptr<double[]> rewards_;  // [reward_slots]
  std::vector<bool> is_blind_;               // [kept]: no valid observation
  Time observed_at_ = kLongAgo;              // of the last step
  std::string traceparent_;                  // of the last step
  std::deque<Episode> episodes_;  // settled ones, then those that wait, and the running one
  size_t settled_ = 0;            // number of the settled ones
  uint64_t next_ = 0;             // number of the next step
  uint64_t base_ = 0;             // number of the first step of the server's session
  uint64_t acknowledged_ = 0;     // number of the step that the server expects next
  uint64_t history_limit_ = 0;
  uint64_t dropped_ = 0;
  uint64_t lost_episodes_ = 0;
};

}  // namespace spikeserve::robot
