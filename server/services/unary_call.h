// A call with one request and one response. The request of a method that streams requests alone is
// what its messages are when they are merged.
//
// Confined to the thread of the call's loop.
#pragma once

#include <cstddef>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/time/time.h"
#include "server/access/admission.h"
#include "server/agent/session_gate.h"
#include "server/messages/step_convert.h"
#include "server/services/call_messages.h"
#include "server/services/finite_response.h"
#include "server/services/request_parser.h"
#include "server/services/service_call.h"
#include "server/transport/limits.h"

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

// Is satisfied by requests that name one session.
template <typename Request>
concept NamesSession = requires(const Request& request) {
  request.session_id();
};

// Is satisfied by requests of operators that act in a policy's place.
template <typename Request>
concept NamesLease = requires(const Request& request) {
  request.lease_id();
};

template <typename Request, typename Response>
class UnaryCall : public ServiceCall, public GatedRequest {
 public:
  using ServiceCall::ServiceCall;

  void OnClosed() override {
    if (method().gathers) loop().Cancel(gathering_);
    ServiceCall::OnClosed();
  }

 protected:
  // Answers the request. Calls Leave() or End() now or later.
  virtual void Handle() = 0;

  CallMessages<Request, Response>& messages() { return messages_; }
  const Request& request() { return *messages_.request(); }
  Response* response() { return messages_.response(); }

  // Ends the call with what its handler has returned, when the gate lets it go.
  void Leave(const absl::Status& status) { context().sessions->Leave(*this, status); }

  // Sends the response and the status of `outcome`, after a delay if the call was refused.
  void End(CallOutcome outcome) {
    if (!checked_) CheckResponse(&outcome);
    Observe(outcome.status, start_, observed_policy());
    EndSpan(outcome.status, &call_context().span);
    if (call() == nullptr) return;
    // A caller who has to wait for a refusal keeps nothing here, and an answer that waits counts.
    if (!outcome.status.ok()) messages_.Free();
    HoldMessages(framed_bytes()).IgnoreError();
    AfterDelay(outcome.refusal, request_bytes_, [this, status = outcome.status] {
      if (status.ok()) SendResponse();
      Finish(status);
    });
  }

  // Counts what the messages occupy, and `more` bytes. Returns RESOURCE_EXHAUSTED if the tenant or
  // the server exceeds its limit. REQUIRES: the call is not over.
  absl::Status HoldMessages(int64_t more = 0) {
    const int64_t held = messages_.extra_bytes() + more;
    return call()->Hold(held) ? absl::OkStatus() : TooManyBytesError();
  }

  // Replaces a response with NaN or infinity by an error. Takes long for a long response, so that a
  // worker which has made the response does this, too.
  void CheckResponse(CallOutcome* outcome) {
    if constexpr (!kHoldsDecisions<Response>) {
      if (!outcome->status.ok()) return;
      const std::string named = PolicyOf(*response());
      const std::string policy = named.empty() ? PolicyOf(request()) : named;
      auto status = CheckFinite(*response(), policy);
      checked_ = true;
      if (status.ok()) return;
      context().metrics->CountNonFiniteAnswer(policy);
      *outcome = CallOutcome(std::move(status));
    }
  }

  // Returns the policy that a decision was asked of; empty: the call makes none, or several.
  virtual absl::string_view observed_policy() const { return ""; }

  // Returns what the response occupies beside the messages.
  virtual int64_t framed_bytes() const { return 0; }

  virtual void SendResponse() { call()->Send(*response()); }

  // Of GatedRequest.
  std::shared_ptr<GatedRequest> Self() override {
    return std::static_pointer_cast<UnaryCall>(this->shared_from_this());
  }
  SessionRecovery::Post post() override { return PostTo(&loop()); }
  bool is_over() override { return call() == nullptr; }
  // A session that could not be opened, because the store has it, is missing, too. One that an
  // operator wants to steer stays where its robot is.
  std::vector<std::string> MissingSessions(const absl::Status& status) override {
    if constexpr (NamesSession<Request> && !NamesLease<Request>) {
      const bool is_in_store =
          std::is_same_v<Request, v1::OpenSessionRequest> && absl::IsAlreadyExists(status);
      if (absl::IsNotFound(status) || is_in_store) return {request().session_id()};
    }
    return {};
  }
  void HandleAgain(const std::map<std::string, absl::Status>& /*unclaimed*/) override {
    response()->Clear();
    checked_ = false;
    Handle();
  }
  bool only_reads() const override {
    return std::is_same_v<Request, v1::GetSessionRequest> ||
           std::is_same_v<Request, v1::ExplainRequest> ||
           std::is_same_v<Request, v1::ExportSessionRequest>;
  }
  void TakeMerged(const FleetContribution& contribution) override {
    if constexpr (std::is_same_v<Response, v1::EndEpisodeResponse> ||
                  std::is_same_v<Response, v1::AmendEpisodeResponse>) {
      const auto merged = contribution.merged();
      if (merged.has_value()) *response()->mutable_learning() = ToProto(*merged);
    }
  }
  void Answer(const absl::Status& status) override { End(status); }

 private:
  void HandleMessage(absl::string_view message) final {
    if (is_refused_) return;
    if (received_ && !method().gathers) {
      return Finish(absl::InternalError("message: expected one request, received a second one"));
    }
    const bool is_first = !std::exchange(received_, true);
    if (is_first) Begin();
    request_bytes_ += message.size();
    auto status =
        CheckSize(caller(), static_cast<int64_t>(message.size()), context().max_message_bytes);
    if (status.ok() && is_first) {
      status = ParseRequest(message, messages_.request());
    } else if (status.ok()) {
      Request more;
      status = ParseRequest(message, &more);
      messages_.request()->MergeFrom(more);
    }
    // The arena does not count the content of its strings.
    const auto gathered = method().gathers ? static_cast<int64_t>(request_bytes_) : 0;
    if (status.ok()) status = HoldMessages(gathered);
    if (!status.ok()) {
      is_refused_ = true;
      return End(status);
    }
    if (!method().gathers) Proceed();
  }

  void HandleHalfClose() final {
    if (!received_) {
      Finish(absl::InternalError("message: expected one request, received none"));
    } else if (method().gathers && !is_refused_) {
      loop().Cancel(gathering_);
      Proceed();
    }
  }

  void Begin() {
    start_ = context().clock->Now();
    call_context().span = StartSpan(call()->head().trace);
    if (!method().gathers) return;
    gathering_ = loop().After(kGatheringTime, [this] {
      is_refused_ = true;
      Finish(absl::DeadlineExceededError(absl::StrCat("message: expected the whole request within ",
                                                      absl::FormatDuration(kGatheringTime),
                                                      ", received a part")));
    });
  }

  void Proceed() {
    call_context().caller = &caller();
    call_context().has_paid = call()->head().admitted != nullptr;
    context().sessions->Enter(&call_context());
    Handle();
  }

  void HandleTooLong(size_t length, const absl::Status& error) final {
    if (is_refused_) return;
    start_ = context().clock->Now();
    request_bytes_ = length;
    received_ = true;
    is_refused_ = true;
    End(error);
  }

  // In which the messages of a streamed request have to arrive.
  static constexpr absl::Duration kGatheringTime = absl::Minutes(2);

  CallMessages<Request, Response> messages_;
  absl::Duration start_;
  EventLoop::Timer gathering_;
  size_t request_bytes_ = 0;
  bool received_ = false;
  bool is_refused_ = false;  // before all of the request was received
  bool checked_ = false;     // the response is finite
};

}  // namespace spikeserve
