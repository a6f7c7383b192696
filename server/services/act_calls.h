// Act, ActBatch and ActStream: calls whose decisions an ActQueue makes.
//
// Confined to the thread of the call's loop.
#ifndef SERVER_SERVICES_ACT_CALLS_H_
#define SERVER_SERVICES_ACT_CALLS_H_

#include <cstddef>
#include <memory>

#include "absl/status/status.h"
#include "server/services/act_queue.h"
#include "server/services/service_call.h"
#include "server/services/unary_call.h"

namespace spikeserve {

class ActCall final : public UnaryCall<v1::ActRequest, v1::ActResponse>, public ActClient {
 public:
  // `queue` must outlive the call.
  ActCall(const ServiceContext* context, Call* call, ActQueue* queue)
      : UnaryCall(context, call, Method::kAct), queue_(*queue) {}

  void OnDecided(ActMessages& messages, const absl::Status& status, size_t request_bytes,
                 absl::Duration received) override;

 private:
  void Handle() override;

  ActQueue& queue_;
};

// Decides its requests in groups, one in a turn of the loop, so that other calls do not wait for
// all of them.
class ActBatchCall final : public UnaryCall<v1::ActBatchRequest, v1::ActBatchResponse>,
                           public ActBatchClient {
 public:
  // `queue` must outlive the call.
  ActBatchCall(const ServiceContext* context, Call* call, ActQueue* queue)
      : UnaryCall(context, call, Method::kActBatch), queue_(*queue) {}

  bool DecideGroup(const PolicyHandler& handler, DeferredWork* deferred) override;

 private:
  void Handle() override;

  ActQueue& queue_;
  int decided_ = 0;  // requests
  absl::Duration received_at_;
};

// Answers any number of requests. A request that fails is answered with its error, and the stream
// goes on; after a refusal it reads on when the caller has waited.
class ActStreamCall final : public ServiceCall, public ActClient {
 public:
  ActStreamCall(const ServiceContext* context, Call* call, ActQueue* queue)
      : ServiceCall(context, call, Method::kActStream), queue_(*queue) {}

  void OnDrain() override;
  void OnGranted() override;
  void OnDecided(ActMessages& messages, const absl::Status& status, size_t request_bytes,
                 absl::Duration received) override;

 private:
  void HandleMessage(absl::string_view message) override;
  void HandleTooLong(size_t length, const absl::Status& error) override;
  void HandleHalfClose() override;
  // Counts a request in progress. Returns how many there are.
  size_t CountRequest(size_t bytes);
  // Counts what the requests in progress occupy. Returns false if that exceeds a limit.
  bool HoldRequests();
  // Finishes the call if its last request is answered and no other follows.
  void FinishIfDone();

  // The stream reads no further requests while this many wait, so that a client that reads no
  // answers soon has to stop sending.
  static constexpr size_t kMaxInProgress = 64;

  ActQueue& queue_;
  size_t in_progress_ = 0;        // requests that wait for their answer
  size_t in_progress_bytes_ = 0;  // as they arrived
  bool limited_ = false;  // the request that was read last may be refused, and no other is read
  bool half_closed_ = false;
  bool draining_ = false;
};

}  // namespace spikeserve

#endif  // SERVER_SERVICES_ACT_CALLS_H_
