// Decisions for several sessions at a time, and what is left to do once their answers are sent.
#ifndef SERVER_ACT_TOGETHER_H_
#define SERVER_ACT_TOGETHER_H_

#include <cstdint>
#include <memory>
#include <optional>
#include <utility>

#include "absl/container/inlined_vector.h"
#include "absl/status/status.h"
#include "absl/types/span.h"
#include "core/session/session_store.h"
#include "server/shadow_runner.h"
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
using ActItems = absl::InlinedVector<ActItem, 1>;

// Fills in each item's `response` or `status`, as if one after the other, bit for bit. Thread-safe.
// REQUIRES: no session is there twice.
void ActTogether(absl::Span<ActItem> items);

// What is left to do once answers have been sent: the action tokens of the sessions that decided,
// and what their shadows are to see. And what comes before that, where a part of a call was
// refused: its caller waits as if all of it had been.
class DeferredWork {
 public:
  void set_refusal(absl::Status refusal) { refusal_ = std::move(refusal); }
  const absl::Status& refusal() const { return refusal_; }

  // `shadows` must outlive this object.
  void Add(std::shared_ptr<SessionEntry> entry, ShadowRunner* shadows) {
    entries_.push_back(std::move(entry));
    shadows_ = shadows;
  }
  void Run();

 private:
  absl::InlinedVector<std::shared_ptr<SessionEntry>, 1> entries_;
  ShadowRunner* shadows_ = nullptr;
  absl::Status refusal_;
};

}  // namespace spikeserve

#endif  // SERVER_ACT_TOGETHER_H_
