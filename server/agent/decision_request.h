// One request for a decision, or for the end of an episode behind its history, and how several are
// answered at once.
#pragma once

#include <cstddef>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "core/agent/step.h"
#include "core/open_sessions/session_store.h"
#include "server/agent/call_context.h"
#include "server/policies/session_holds.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// The largest number of requests that are decided together. More requests would not reduce the
// memory traffic of the weights further, and would lock more sessions against other callers.
inline constexpr size_t kMaxSessionsPerGroup = 16;

// The life of a request. Later requests for its session wait until it is answered.
enum class DecisionState {
  kWaiting,   // it is to be decided; a part of its history may be taken already
  kClaiming,  // its session is taken over from the store, and then it waits again
  kAnswered,  // it has its response, or the error
};

// One request, from its arrival to its answer.
struct DecisionRequest {
  CallContext* context = nullptr;  // of the request, or of the batch that it is an item of
  const v1::ActRequest* request = nullptr;
  v1::ActResponse* response = nullptr;
  DecisionState state = DecisionState::kWaiting;
  int item = -1;         // index in the batch; -1: a request of its own
  bool is_next = false;  // true: decides at the step that the session expects, so never a retry
  std::shared_ptr<SessionEntry> entry = nullptr;  // only while it is decided
  absl::Status status = absl::OkStatus();
  std::string policy = "";                         // of the session; empty: none was found
  absl::Duration received = absl::ZeroDuration();  // by the clock
  Step step = {};                                  // of the session, while it is decided

  bool is_answered() const { return state == DecisionState::kAnswered; }
  // Lets a request that was decided, or refused with `status`, be answered, or wait for a claim.
  void Conclude();
  // Lets a request whose session was taken over wait again. If it was not, `claimed` is the answer.
  void OnClaimed(const absl::Status& claimed);
};

// Computes the decision of each of `acts` and sets its `response`, or its `status` to the error,
// and adds what the answer waits for to its context. The results equal those of deciding one after
// the other, bit for bit. Thread-safe. REQUIRES: each has its `entry`, and no two the same.
// `budget` bounds the beats that are appended. Sessions are held as `holds` says.
void DecideActs(absl::Span<DecisionRequest* const> acts, const SessionHolds& holds,
                StepBudget* budget);

}  // namespace spikeserve
