// Decisions for several sessions at a time.
#ifndef SERVER_AGENT_ACT_TOGETHER_H_
#define SERVER_AGENT_ACT_TOGETHER_H_

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>

#include "absl/status/status.h"
#include "absl/types/span.h"
#include "core/session/session_store.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Requests that are decided together. More would save no more of the weights' traffic, and keep
// more sessions from whoever else asks for them.
inline constexpr size_t kDecidedTogether = 16;

// A request, its session and the place of its answer.
struct ActItem {
  const v1::ActRequest* request = nullptr;
  std::optional<int64_t> step;  // absent: the one that the session expects, so never a retry
  std::shared_ptr<SessionEntry> entry;
  v1::ActResponse* response = nullptr;
  absl::Status status = absl::OkStatus();
};

// Fills in each item's `response` or `status`, as if one after the other, bit for bit. Thread-safe.
// REQUIRES: no session is there twice.
void ActTogether(absl::Span<ActItem> items);

}  // namespace spikeserve

#endif  // SERVER_AGENT_ACT_TOGETHER_H_
