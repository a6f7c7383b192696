// The server's session on the robot's own engine. Plays every step that the robot plays, so that
// the two sessions are equal: a decision follows each step on both sides, and the executed action
// takes its place.
//
// The engine works on another thread than the robot. So each step has three parts: Prepare copies
// a step from the log, the engine plays work(), Commit moves on.
//
// Not thread-safe; between Prepare and Commit, work() may be read while others use the rest.
#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "core/robot/action_shape.h"
#include "core/robot/step_log.h"

namespace spikeserve::robot {

enum class LocalState {
  kNone,    // there is no engine
  kWanted,  // the engine needs the server's session
  kReady,   // it plays
  kStale,   // it plays, with a head that the fleet has changed meanwhile
  kUnfit,   // it cannot play this session
};

// What the engine plays next.
struct LocalWork {
  bool is_end = false;  // of the episode, otherwise a step
  uint64_t number = 0;
  int64_t step = 0;
  std::vector<float> observation = {};
  double reward = 0.0;
  bool has_executed = false;  // otherwise the step is the first one
  ActionValue executed = {};  // in the step before
  ChooserValue chooser = {};  // of it
  Outcome outcome = {};
};

class LocalSession {
 public:
  explicit LocalSession(bool has_engine)
      : state_(has_engine ? LocalState::kWanted : LocalState::kNone) {}

  LocalState state() const { return state_; }
  bool is_ready() const { return state_ == LocalState::kReady || state_ == LocalState::kStale; }
  bool wants_export() const {
    return state_ == LocalState::kWanted || state_ == LocalState::kStale;
  }

  // Notes that the engine has resumed before decision `decision` of the session, at `step` of
  // `episode`. Returns false if steps that follow are not in `log`; another export may help.
  bool Resumed(uint64_t decision, int64_t episode, int64_t step, const StepLog& log) {
    const uint64_t next = log.NumberOf(decision);
    const Episode* const known = log.Find(episode);
    if (known == nullptr || next != known->first + static_cast<uint64_t>(step) ||
        next > known->past() || (step > 0 && !log.Has(next - 1))) {
      state_ = LocalState::kWanted;
      return false;
    }
    episode_ = episode;
    next_ = next;
    state_ = LocalState::kReady;
    return true;
  }

  // Notes that the engine has to resume before it can go on.
  void Stop() {
    if (state_ != LocalState::kNone) state_ = LocalState::kWanted;
  }

  // Notes that the engine cannot resume; one that plays goes on.
  void Refused() { state_ = is_ready() ? LocalState::kReady : LocalState::kUnfit; }
  // Notes that the fleet has changed the head.
  void Outdated() {
    if (is_ready()) state_ = LocalState::kStale;
  }

  // Copies what the engine has to play next. Returns false if there is nothing. An engine that was
  // too slow for the log stops.
  bool Prepare(const StepLog& log) {
    if (!is_ready()) return false;
    const Episode* const episode = log.Find(episode_);
    if (episode == nullptr || (next_ < log.next() && !log.Has(next_)) ||
        (next_ > episode->first && !log.Has(next_ - 1))) {
      Stop();
      return false;
    }
    work_.is_end = next_ == episode->past() && episode->has_ended();
    if (next_ == episode->past() && !work_.is_end) return false;
    work_.number = next_;
    work_.step = static_cast<int64_t>(next_ - episode->first);
    work_.has_executed = work_.step > 0;
    if (work_.has_executed) {
      const StepView before = log.At(next_ - 1);
      work_.executed.Assign(before.executed);
      work_.chooser.Assign(before.chooser);
    }
    if (work_.is_end) {
      work_.outcome = episode->outcome;
      return true;
    }
    const StepView step = log.At(next_);
    work_.observation.assign(step.observation.begin(), step.observation.end());
    work_.reward = step.reward;
    return true;
  }

  const LocalWork& work() const { return work_; }
  // Moves on, after the engine has played work(). Returns the number of the step that it decided
  // for; nothing after the end of an episode, or a step without an observation.
  std::optional<uint64_t> Commit() {
    if (work_.is_end) {
      ++episode_;
      return std::nullopt;
    }
    ++next_;
    return work_.observation.empty() ? std::nullopt : std::optional(work_.number);
  }

 private:
  LocalState state_;
  int64_t episode_ = 0;  // index of the episode of the next step
  uint64_t next_ = 0;    // number of the next step
  LocalWork work_;
};

}  // namespace spikeserve::robot
