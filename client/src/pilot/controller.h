// The robot's side of a pilot: what a beat does on the robot's own thread. It waits for decisions
// within its budget, and allocates no memory.
//
// For one thread, but Stats and session_id.
#ifndef CLIENT_SRC_PILOT_CONTROLLER_H_
#define CLIENT_SRC_PILOT_CONTROLLER_H_

#include <cstdint>
#include <future>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "client/src/pilot/link.h"
#include "client/src/pilot/shared_state.h"
#include "spikeserve/pilot.h"

namespace spikeserve {

class Pilot::Controller {
 public:
  // `opening` has opened the session with the answer `opened`, on `route`. `neutral` belongs to its
  // action space.
  Controller(Replicas* replicas, piloting::BackgroundThread* background,
             std::shared_ptr<Route> route, v1::OpenSessionRequest opening,
             const v1::OpenSessionResponse& opened, const piloting::ActionValue& neutral,
             PilotOptions options);

  piloting::Link& link() { return link_; }
  const PilotOptions& options() const { return options_; }

  // Those of Pilot.
  PilotAction Beat(absl::Span<const float> observation, double reward,
                   const std::optional<ActionView>& executed) ABSL_LOCKS_EXCLUDED(state_.mutex);
  std::future<Summary> EndEpisode(EpisodeOutcome outcome) ABSL_LOCKS_EXCLUDED(state_.mutex);
  bool WaitReady(absl::Duration timeout) ABSL_LOCKS_EXCLUDED(state_.mutex);
  PilotStats Stats() const ABSL_LOCKS_EXCLUDED(state_.mutex);
  std::string session_id() const ABSL_LOCKS_EXCLUDED(state_.mutex);

 private:
  // Returns the trace context of this beat.
  absl::string_view Traceparent() const;
  // Asks for the decision of the newest beat, if a request may be sent. A beat without an
  // observation (`sees` is false) asks for nothing: it only reports, and brings what was before.
  void Queue(uint64_t number, bool sees, absl::Duration now)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_.mutex);
  // Takes the best action but the robot's own one, and waits for it until `deadline`. Returns false
  // if there is none. Nothing is decided without an observation.
  bool Choose(uint64_t number, bool sees, absl::Duration observed_at, absl::Duration deadline)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_.mutex);
  bool TakeAnswer(absl::Duration deadline) ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_.mutex);
  bool TakeLocal(uint64_t number, absl::Duration observed_at, absl::Duration deadline)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_.mutex);
  // Returns whether the server's newest answer may be executed.
  bool HasAnswer() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_.mutex);
  // Returns the newest beat whose answer should arrive before `deadline`; nothing: none should.
  std::optional<uint64_t> ExpectedAnswer(absl::Duration deadline) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_.mutex);
  // Waits for a decision. Returns false at the deadline.
  bool Wait(absl::Duration deadline) ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_.mutex);
  // Returns the action of the robot's own function for an observation, or the neutral one. Sets
  // `failed` if the function threw, or returned an action that is none.
  ActionView Fallback(absl::Span<const float> observation, bool* failed);
  // Returns the error of a beat before the first valid observation.
  PilotAction RefuseBeat(const piloting::Blindness& why) ABSL_LOCKS_EXCLUDED(state_.mutex);
  PilotAction Finish() ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_.mutex);

  // Replace what is not valid, which is counted, and logged once.
  double Finite(double reward) ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_.mutex);
  void TakeExecuted(const std::optional<ActionView>& executed)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_.mutex);
  void Replace(piloting::Replaced kind) ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_.mutex);

  const PilotOptions options_;
  const std::shared_ptr<Route> route_;
  const piloting::ActionShape shape_;
  const piloting::ActionValue neutral_;
  piloting::SharedState state_;
  piloting::Link link_;

  const std::vector<float> no_observation_;  // NaN in each element
  bool is_miswired_ = false;                 // says the newest answer: actions are safe ones
  bool has_seen_ = false;                    // whether an observation was valid
  piloting::ActionValue fitted_;             // an action of the caller, with its elements in bounds
  piloting::ActionValue returned_;           // by the last beat
  uint64_t next_answer_ = 0;                 // answers to older beats are not executed
  uint64_t beats_ = 0;
  bool is_new_episode_ = true;
};

}  // namespace spikeserve

#endif  // CLIENT_SRC_PILOT_CONTROLLER_H_
