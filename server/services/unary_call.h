// A call with one request and one response. The request of a method that streams requests alone is
// what its messages are when they are merged.
//
// Confined to the thread of the call's loop.
#pragma once

#include <google/protobuf/message.h>

#include <cstddef>
#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "server/agent/session_gate.h"
#include "server/services/call_messages.h"
#include "server/services/service_call.h"

namespace spikeserve {

// The result of a call.
struct CallOutcome {
  // NOLINTNEXTLINE(google-explicit-constructor): a handler returns a plain status as its outcome.
  CallOutcome(absl::Status ended) : status(ended), refusal(std::move(ended)) {}
  CallOutcome(absl::Status ended, absl::Status refused)
      : status(std::move(ended)), refusal(std::move(refused)) {}

  absl::Status status;   // sent to the caller
  absl::Status refusal;  // decides how long the answer is delayed; differs from `status` for a
                         // batch that succeeds but contains refused items
};

// Knows its messages by their descriptors: there are fifty methods, and a template of this class
// would be compiled for each.
class UnaryCall : public ServiceCall, public GatedRequest {
 public:
  using Message = google::protobuf::Message;

  // The messages have the types of `request` and `response`, which must outlive the call, as must
  // `context`.
  UnaryCall(const ServiceContext* context, Call* call, const Method& method, const Message& request,
            const Message& response)
      : ServiceCall(context, call, method), messages_(request, response) {}

  void OnClosed() override;

 protected:
  // Answers the request. Calls Leave() or End() now or later.
  virtual void Handle() = 0;

  CallMessages& messages() { return messages_; }
  const Message& request() const { return *messages_.request(); }
  Message* response() const { return messages_.response(); }

  // Ends the call with what its handler has returned, when the gate lets it go.
  void Leave(const absl::Status& status) { context().sessions->Leave(*this, status); }

  // Sends the response and the status of `outcome`, after a delay if the call was refused.
  void End(CallOutcome outcome);

  // Counts what the messages occupy, and `more` bytes. Returns RESOURCE_EXHAUSTED if the tenant or
  // the server exceeds its limit. REQUIRES: the call is not over.
  absl::Status HoldMessages(int64_t more = 0);

  // Replaces a response with NaN or infinity by an error. Takes long for a long response, so that a
  // worker which has made the response does this, too.
  void CheckResponse(CallOutcome* outcome);

  // Returns the policy that a decision was asked of; empty: the call makes none, or several.
  virtual absl::string_view observed_policy() const { return ""; }

  // Returns what the response occupies beside the messages.
  virtual int64_t framed_bytes() const { return 0; }

  virtual void SendResponse() { call()->Send(*response()); }

  // Of GatedRequest.
  std::shared_ptr<GatedRequest> Self() override {
    return std::static_pointer_cast<UnaryCall>(shared_from_this());
  }
  SessionRecovery::Post post() override { return PostTo(&loop()); }
  bool is_over() override { return call() == nullptr; }
  std::vector<std::string> MissingSessions(const absl::Status& status) override;
  void HandleAgain(const std::map<std::string, absl::Status>& unclaimed) override;
  bool only_reads() const override;
  void TakeMerged(const FleetContribution& contribution) override;
  void Answer(const absl::Status& status) override { End(status); }

 private:
  void HandleMessage(absl::string_view message) final;
  void HandleHalfClose() final;
  void HandleTooLong(size_t length, const absl::Status& error) final;
  void Begin();
  // Reads one message of the request.
  absl::Status Read(absl::string_view message, bool is_first);
  void Proceed();

  CallMessages messages_;
  absl::Duration start_;
  EventLoop::Timer gathering_;
  size_t request_bytes_ = 0;
  bool received_ = false;
  bool is_refused_ = false;  // before all of the request was received
  bool checked_ = false;     // the response is finite
};

}  // namespace spikeserve
