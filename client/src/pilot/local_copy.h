// The session of the server on the robot's own engine. Plays every beat that the robot plays, so
// that the two sessions are equal: a decision follows each beat on both sides, and the executed
// action takes its place.
//
// The engine works on the background thread and without the lock of the pilot. So each step has
// three parts: Prepare copies a beat from the log, Play lets the engine work, Commit moves on.
//
// Not thread-safe.
#ifndef CLIENT_SRC_PILOT_LOCAL_COPY_H_
#define CLIENT_SRC_PILOT_LOCAL_COPY_H_

#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "client/src/pilot/action_shape.h"
#include "client/src/pilot/beat_log.h"
#include "spikeserve/local_policy.h"

namespace spikeserve::piloting {

class LocalCopy {
 public:
  // Null: there is no engine on the robot.
  explicit LocalCopy(std::shared_ptr<LocalPolicy> policy) : policy_(std::move(policy)) {}

  LocalPolicy* policy() const { return policy_.get(); }
  // Returns whether the engine has the session.
  bool is_ready() const { return is_ready_; }

  // Notes that the engine has resumed from an export. Returns FAILED_PRECONDITION if beats that
  // follow it are not in `log`; another export may help.
  absl::Status Resumed(const v1::ExportSessionResponse& exported, const BeatLog& log);
  // Notes that the engine has to resume before it can go on.
  void Stop() { is_ready_ = false; }

  // Copies what the engine has to play next. Returns false if there is nothing.
  bool Prepare(const BeatLog& log);
  // Plays it. Needs no lock of `log`.
  absl::Status Play();
  // Moves on, after Play has returned OK. Returns the number of the beat that action() is for;
  // nothing after the end of an episode, or a beat without an observation.
  std::optional<uint64_t> Commit();
  ActionView action() const { return action_; }

 private:
  struct Work {
    bool is_end = false;  // of the episode, otherwise a beat
    uint64_t number = 0;
    int64_t step = 0;
    std::vector<float> observation = {};
    double reward = 0.0;
    bool has_executed = false;
    ActionValue executed = {};
    EpisodeOutcome outcome = {};
  };

  const std::shared_ptr<LocalPolicy> policy_;
  bool is_ready_ = false;
  int64_t episode_ = 0;  // index of the episode of the next beat
  uint64_t next_ = 0;    // number of the next beat
  Work work_;
  ActionView action_;  // the last decision
};

}  // namespace spikeserve::piloting

#endif  // CLIENT_SRC_PILOT_LOCAL_COPY_H_
