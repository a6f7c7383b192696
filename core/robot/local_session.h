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
  bool Resumed(uint64_t decision, int64_t episode, int64_t step, const StepLog& log);
  // Notes that the engine has to resume before it can go on.
  void Stop();
  // Notes that the engine cannot resume; one that plays goes on.
  void Refused() { state_ = is_ready() ? LocalState::kReady : LocalState::kUnfit; }
  // Notes that the fleet has changed the head.
  void Outdated() {
    if (is_ready()) state_ = LocalState::kStale;
  }

  // Copies what the engine has to play next. Returns false if there is nothing. An engine that was
  // too slow for the log stops.
  bool Prepare(const StepLog& log);
  const LocalWork& work() const { return work_; }
  // Moves on, after the engine has played work(). Returns the number of the step that it decided
  // for; nothing after the end of an episode, or a step without an observation.
  std::optional<uint64_t> Commit();

 private:
  LocalState state_;
  int64_t episode_ = 0;  // index of the episode of the next step
  uint64_t next_ = 0;    // number of the next step
  LocalWork work_;
};

}  // namespace spikeserve::robot
