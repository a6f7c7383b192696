// Computes decisions for several sessions at once.
#ifndef SERVER_AGENT_ACT_TOGETHER_H_
#define SERVER_AGENT_ACT_TOGETHER_H_

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>

#include "absl/status/status.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "core/base/clock.h"
#include "core/session/session_store.h"
#include "server/agent/beat_requests.h"
#include "server/agent/durable_answer.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// The largest number of requests that are decided together. More requests would not reduce the
// memory traffic of the weights further, and would lock more sessions against other callers.
inline constexpr size_t kMaxSessionsPerGroup = 16;

// One request of a group, its session and its response.
struct ActItem {
  const v1::ActRequest* request = nullptr;
  std::optional<int64_t> step;  // absent: the step that the session expects, so never a retry
  std::shared_ptr<SessionEntry> entry;
  v1::ActResponse* response = nullptr;
  absl::Status status = absl::OkStatus();
  Commits commits = {};  // what the answer waits for
  // When the request was received, by the clock; used if it has beats (beat_requests.h).
  absl::Duration received = absl::ZeroDuration();
  // Of a request with beats. If it has not finished, `status` is OK and the item is to be passed
  // again, before others of the session.
  BeatProgress beats = {};
  // True: a request that is ahead of a stored session gets NOT_FOUND and makes this copy lost, so
  // that the caller claims the session again. Another server may have decided in between.
  bool may_claim = false;
};

// Computes the decision of each item and sets its `response`, or its `status` to the error. The
// results equal those of deciding the items one after the other, bit for bit. Thread-safe.
// REQUIRES: each session occurs at most once in `items`.
void ActTogether(absl::Span<ActItem> items, const Clock& clock);

}  // namespace spikeserve

#endif  // SERVER_AGENT_ACT_TOGETHER_H_
