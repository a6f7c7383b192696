// Act, ActBatch and ActStream: calls whose decisions an ActQueue makes.
//
// Confined to the thread of the call's loop.
#pragma once

#include <cstddef>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "server/services/act_queue.h"
#include "server/services/service_call.h"
#include "server/services/unary_call.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Decides its requests in groups, one in a turn of the loop, so that other calls do not wait for
// all of them.
class ActBatchCall final : public UnaryCall, public QueuedBatch {
 public:
  // `queue` must outlive the call.
  ActBatchCall(const ServiceContext* context, Call* call, const Method& method, ActQueue* queue)
      : UnaryCall(context, call, method, v1::ActBatchRequest::default_instance(),
                  v1::ActBatchResponse::default_instance()),
        queue_(*queue) {}

  bool DecideGroup(const PolicyHandler& handler, DeferredWork* deferred,
                   StepBudget* budget) override;

 private:
  const v1::ActBatchRequest& request() const {
    return static_cast<const v1::ActBatchRequest&>(UnaryCall::request());
  }
  v1::ActBatchResponse* response() const {
    return static_cast<v1::ActBatchResponse*>(UnaryCall::response());
  }

  void Handle() override;
  std::vector<std::string> MissingSessions(const absl::Status& status) override;
  bool has_items() const override { return true; }
  void HandleAgain(const std::map<std::string, absl::Status>& unclaimed) override;
  void FailItem(int item, const absl::Status& status) override;
  void Answer(const absl::Status& status) override { End({status, refusal_}); }
  // Replaces the results of items that found no session by the reasons why it could not be taken
  // over.
  void ExplainMissing();

  ActQueue& queue_;
  int decided_ = 0;  // requests
  absl::Duration received_at_;
  StepOutcome progress_;  // of the next request, if a part of it was handled
  std::map<std::string, absl::Status> unclaimed_;  // why sessions could not be taken over
  absl::Status refusal_;  // of an item that exceeded a limit of its tenant; OK if there is none
};

// Act and ActStream: answers one request, or any number, those of one session in their order. On a
// stream a request that fails is answered with its error, and the stream continues; after a refusal
// the next request is read when the delay of the refusal is over.
class ActCall final : public ServiceCall {
 public:
  // `queue` must outlive the call.
  ActCall(const ServiceContext* context, Call* call, const Method& method, ActQueue* queue)
      : ServiceCall(context, call, method), queue_(*queue) {}

  void OnDrain() override;

 private:
  class Item;

  void HandleMessage(absl::string_view message) override;
  void HandleTooLong(size_t length, const absl::Status& error) override;
  void HandleHalfClose() override;
  // Returns a new request, which is in progress.
  std::shared_ptr<Item> NewItem(size_t bytes);
  // The request that was read last will not be refused.
  void OnGranted();
  // Sends the answer to a request, or its error.
  void Send(Item& item, const absl::Status& status);
  // Takes a request that is answered, or gone, from those that wait. Returns the last one of its
  // session before it that still waits, or null.
  Item* TakeOut(const Item& item);
  // Counts what the requests in progress occupy. Returns false if that exceeds a limit.
  bool HoldRequests();
  // Finishes a stream if its last request is answered and no other follows.
  void FinishIfDone();

  // A stream reads no further requests while this many wait, so that a client that reads no answers
  // soon has to stop sending.
  static constexpr size_t kMaxInProgress = 64;

  ActQueue& queue_;
  std::vector<Item*> waiting_;    // requests that have no answer, in the order of their arrival
  size_t in_progress_ = 0;        // those, and the ones whose answer waits for one of them
  size_t in_progress_bytes_ = 0;  // as they arrived
  bool has_request_ = false;
  bool limited_ = false;  // the request that was read last may be refused, and no other is read
  bool half_closed_ = false;
  bool draining_ = false;
};

}  // namespace spikeserve
