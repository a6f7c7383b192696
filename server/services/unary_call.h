// A call with one request and one response.
//
// Confined to the thread of the call's loop.
#ifndef SERVER_SERVICES_UNARY_CALL_H_
#define SERVER_SERVICES_UNARY_CALL_H_

#include <cstddef>
#include <utility>

#include "absl/status/status.h"
#include "server/access/admission.h"
#include "server/services/call_messages.h"
#include "server/services/request_parser.h"
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

template <typename Request, typename Response>
class UnaryCall : public ServiceCall {
 public:
  using ServiceCall::ServiceCall;

 protected:
  // Answers the request. Calls End() now or later.
  virtual void Handle() = 0;

  CallMessages<Request, Response>& messages() { return messages_; }
  const Request& request() { return *messages_.request(); }
  Response* response() { return messages_.response(); }

  // Sends the response and the status of `outcome`, after a delay if the call was refused.
  void End(const CallOutcome& outcome) {
    Observe(outcome.status, start_);
    if (call() == nullptr) return;
    AfterDelay(outcome.refusal, request_bytes_, [this, status = outcome.status] {
      if (status.ok()) call()->Send(*response());
      Finish(status);
    });
  }

 private:
  void HandleMessage(absl::string_view message) final {
    start_ = context().clock->Now();
    request_bytes_ = message.size();
    if (std::exchange(received_, true)) {
      return Finish(absl::InternalError("message: expected one request, received a second one"));
    }
    auto status =
        CheckSize(caller(), static_cast<int64_t>(message.size()), context().max_message_bytes);
    if (status.ok()) status = ParseRequest(message, messages_.request());
    if (!status.ok()) return End(status);
    Handle();
  }

  void HandleHalfClose() final {
    if (!received_) {
      Finish(absl::InternalError("message: expected one request, received none"));
    }
  }

  void HandleTooLong(size_t length, const absl::Status& error) final {
    start_ = context().clock->Now();
    request_bytes_ = length;
    received_ = true;
    End(error);
  }

  CallMessages<Request, Response> messages_;
  absl::Duration start_;
  size_t request_bytes_ = 0;
  bool received_ = false;
};

}  // namespace spikeserve

#endif  // SERVER_SERVICES_UNARY_CALL_H_
