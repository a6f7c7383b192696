// A call with one request and one response.
//
// Confined to the thread of the call's loop.
#ifndef SERVER_SERVICES_UNARY_CALL_H_
#define SERVER_SERVICES_UNARY_CALL_H_

#include <cstddef>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "server/access/admission.h"
#include "server/agent/durable_answer.h"
#include "server/services/call_messages.h"
#include "server/services/finite_response.h"
#include "server/services/request_parser.h"
#include "server/services/service_call.h"
#include "server/services/stored_items.h"

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

  // Gathers what the answer must wait for.
  Commits* commits() { return &commits_; }

  // Returns whether a session whose copy here is an old one may still be taken over from the store.
  bool may_claim() { return context().recovery != nullptr && !recovered_; }

  // As End(), when the store has everything in commits(). If the outcome is that this server does
  // not hold the request's session, takes it over from the store and calls Handle() again.
  void EndWhenDurable(CallOutcome outcome) {
    if (TryToRecover(outcome)) return;
    ExplainMissing(request(), failures_, response());
    const Commits commits = std::exchange(commits_, {});
    if (commits.empty() || call() == nullptr) return End(outcome);
    WhenDurable(commits, [self = Self(), loop = &call()->loop(), outcome,
                          commits](const std::vector<absl::Status>& outcomes) mutable {
      loop->Post([self = std::move(self), outcome, commits, outcomes]() mutable {
        for (size_t i = 0; i < commits.size(); ++i) {
          if (outcomes[i].ok()) {
            if (commits[i].contribution != nullptr) {
              TakeMerged(*commits[i].contribution, self->response());
            }
          } else if (commits[i].item >= 0) {
            FailItem(commits[i].item, outcomes[i], self->response());
          } else {
            outcome = outcomes[i];
          }
        }
        self->EndWhenDurable(outcome);
      });
    });
  }

  // Sends the response and the status of `outcome`, after a delay if the call was refused.
  void End(CallOutcome outcome) {
    if (!checked_) CheckResponse(&outcome);
    Observe(outcome.status, start_);
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

  // Returns what the response occupies beside the messages.
  virtual int64_t framed_bytes() const { return 0; }

  virtual void SendResponse() { call()->Send(*response()); }

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
    if (status.ok()) status = HoldMessages();
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

  std::shared_ptr<UnaryCall> Self() {
    return std::static_pointer_cast<UnaryCall>(this->shared_from_this());
  }

  // Returns true if the call goes on when the store has answered.
  bool TryToRecover(const CallOutcome& outcome) {
    if (context().recovery == nullptr || call() == nullptr || recovered_) return false;
    const auto missing = MissingSessions(request(), *response(), outcome.status);
    if (missing.empty()) return false;
    recovered_ = true;
    missing_ = missing.size();
    const auto post = [loop = &call()->loop()](std::function<void()> work) {
      loop->Post(std::move(work));
    };
    if constexpr (kOnlyReads<Request>) {
      if (context().recovery->is_shared()) {
        Read(missing[0], outcome, post);
        return true;
      }
    }
    for (const std::string& id : missing) {
      context().recovery->Recover(caller(), id, post,
                                  [self = Self(), id, outcome](const absl::Status& status) {
                                    self->OnRecovered(id, status, outcome);
                                  });
    }
    return true;
  }

  // Answers with the session as the store has it.
  void Read(const std::string& id, const CallOutcome& missing, const SessionRecovery::Post& post) {
    context().recovery->Read(caller(), id, post, [self = Self(), missing](const auto& session) {
      if (absl::IsNotFound(session.status())) return self->End(missing);
      if (session.ok()) AnswerWith(**session, self->request(), self->response());
      self->End(session.status());
    });
  }

  void OnRecovered(const std::string& id, const absl::Status& status, const CallOutcome& outcome) {
    const bool failed = !status.ok() && !absl::IsNotFound(status);
    if (failed) failures_.emplace(id, status);
    if (--missing_ > 0) return;
    if (call() == nullptr) return End(outcome);
    if (NamesSession<Request> && !status.ok()) return End(failed ? CallOutcome(status) : outcome);
    HandleAgain();
  }

  void HandleAgain() {
    response()->Clear();
    commits_.clear();
    checked_ = false;
    Handle();
  }

  CallMessages<Request, Response> messages_;
  Commits commits_;
  bool recovered_ = false;  // the missing sessions were looked for in the store
  size_t missing_ = 0;      // sessions that are being looked for
  std::map<std::string, absl::Status> failures_;  // why sessions could not be taken over
  absl::Duration start_;
  size_t request_bytes_ = 0;
  bool received_ = false;
  bool checked_ = false;  // the response is finite
};

}  // namespace spikeserve

#endif  // SERVER_SERVICES_UNARY_CALL_H_
