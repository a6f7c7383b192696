// One request for a decision, or for the end of an episode behind its history, how several are
// answered at once, and what is done when the answers were sent.
//
//   DeferredWork deferred;
//   handler.ActGroup(requests, &deferred, &budget);
//   Send(responses);
//   deferred.Run();
#pragma once

#include <cstddef>
#include <memory>
#include <string>
#include <utility>

#include "absl/container/inlined_vector.h"
#include "absl/status/status.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "core/agent/step.h"
#include "core/open_sessions/session_store.h"
#include "server/agent/call_context.h"
#include "server/followers/shadow_runner.h"
#include "server/policies/session_holds.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// The largest number of requests that are decided together. More requests would not reduce the
// memory traffic of the weights further, and would lock more sessions against other callers.
inline constexpr size_t kMaxSessionsPerGroup = 16;

// The life of a request, however it came. Later requests for its session wait until it is decided.
enum class DecisionState {
  kArriving,  // it is received and checked
  kWaiting,   // it is to be decided; a part of its history may be taken already
  kClaiming,  // its session is taken over from the store, and then it waits again
  kDecided,   // it has its response, or the error, which may wait for the store
  kAnswered,  // the answer is on its way
};

// Returns whether a request may go from one state to the other.
constexpr bool MayFollow(DecisionState from, DecisionState to) {
  switch (to) {
    case DecisionState::kArriving:
      return false;
    case DecisionState::kWaiting:  // from itself, too: again, after a part
      return from <= DecisionState::kClaiming;
    case DecisionState::kClaiming:
      return from == DecisionState::kWaiting;
    case DecisionState::kDecided:
      return from == DecisionState::kWaiting || from == DecisionState::kClaiming;
    case DecisionState::kAnswered:
      return from == DecisionState::kDecided || from == DecisionState::kArriving;  // refused
  }
  return false;
}

// One request, from its arrival to its answer.
struct DecisionRequest {
  CallContext* context = nullptr;  // of the request, or of the batch that it is an item of
  const v1::ActRequest* request = nullptr;
  v1::ActResponse* response = nullptr;
  DecisionState state = DecisionState::kArriving;
  int item = -1;          // index in the batch; -1: a request of its own
  bool has_paid = false;  // counted at the tenant's rate
  bool is_next = false;   // true: decides at the step that the session expects, so never a retry
  std::shared_ptr<SessionEntry> entry = nullptr;  // only while it is decided
  absl::Status status = absl::OkStatus();
  std::string policy = "";                         // of the session; empty: none was found
  absl::Duration received = absl::ZeroDuration();  // by the clock
  Step step = {};                                  // of the session, while it is decided

  bool is_decided() const { return state == DecisionState::kDecided; }
  // REQUIRES: MayFollow(state, next).
  void Become(DecisionState next);
  // Takes what DecideActs() has made of the request, or the refusal `status`: it is decided, waits
  // with the rest of its history, or claims its session.
  void Conclude();
  // Lets a request whose session was taken over wait again. If it was not, `claimed` is the answer.
  void OnClaimed(const absl::Status& claimed);
};

// Collects the sessions that decided during a call. Run() appends the action tokens of their
// decisions to their contexts and submits the steps that their shadows replay. Neither is needed
// for the answer.
//
// Not thread-safe: one call owns it.
class DeferredWork {
 public:
  // Adds a session that decided. `shadows` must outlive this object.
  void Add(std::shared_ptr<SessionEntry> entry, ShadowRunner* shadows) {
    entries_.push_back(std::move(entry));
    shadows_ = shadows;
  }
  // Does the work of all added sessions, then forgets them. REQUIRES: the calling thread holds no
  // session lock.
  void Run();

 private:
  absl::InlinedVector<std::shared_ptr<SessionEntry>, 1> entries_;
  ShadowRunner* shadows_ = nullptr;
};

// Computes the decision of each of `acts` and sets its `response`, or its `status` to the error,
// and adds what the answer waits for to its context. The results equal those of deciding one after
// the other, bit for bit. Thread-safe. REQUIRES: each has its `entry`, and no two the same.
// `budget` bounds the beats that are appended. Sessions are held as `holds` says.
void DecideActs(absl::Span<DecisionRequest* const> acts, const SessionHolds& holds,
                StepBudget* budget);

}  // namespace spikeserve
