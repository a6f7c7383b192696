// Computes decisions for several sessions at once.
#ifndef SERVER_AGENT_ACT_TOGETHER_H_
#define SERVER_AGENT_ACT_TOGETHER_H_

#include <cstddef>
#include <memory>

#include "absl/status/status.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "core/base/clock.h"
#include "core/open_sessions/session_store.h"
#include "server/agent/beat_requests.h"
#include "server/agent/call_context.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// The largest number of requests that are decided together. More requests would not reduce the
// memory traffic of the weights further, and would lock more sessions against other callers.
inline constexpr size_t kMaxSessionsPerGroup = 16;

// One request for a decision, from its arrival to its answer.
struct DecisionRequest {
  CallContext* context = nullptr;  // of the request, or of the batch that it is an item of
  const v1::ActRequest* request = nullptr;
  v1::ActResponse* response = nullptr;
  int item = -1;         // index in the batch; -1: a request of its own
  bool is_next = false;  // true: decides at the step that the session expects, so never a retry
  std::shared_ptr<SessionEntry> entry = nullptr;  // only while it is decided
  absl::Status status = absl::OkStatus();
  std::string policy = "";  // of the session; empty: none was found
  // When the request was received, by the clock; used if it has beats (beat_requests.h).
  absl::Duration received = absl::ZeroDuration();
  BeatProgress beats = {};       // of a request with beats
  Span span = {};                // of the decision, while it is made
  bool waits_for_claim = false;  // its session is to be taken over; see SessionGate

  // False: the request has no answer yet. It is to be decided again, before later requests for its
  // session.
  bool is_finished() const { return !waits_for_claim && (beats.finished || !status.ok()); }
};

// Computes the decision of each of `acts` and sets its `response`, or its `status` to the error,
// and adds what the answer waits for to its context. The results equal those of deciding one after
// the other, bit for bit. Thread-safe. REQUIRES: each has its `entry`, and no two the same.
// `budget` bounds the beats that are appended.
void DecideActs(absl::Span<DecisionRequest* const> acts, const Clock& clock, BeatBudget* budget);

}  // namespace spikeserve

#endif  // SERVER_AGENT_ACT_TOGETHER_H_
