#include "server/services/act_calls.h"

#include <utility>

#include "server/access/admission.h"
#include "server/agent/convert.h"
#include "server/services/request_parser.h"

namespace spikeserve {
namespace {

// What the answer to one item of a batch occupies, before and after it is serialized.
constexpr int64_t kAnswerBytes = 1 << 10;

// Returns the error of an item that exceeded a limit of its tenant; OK if there is none. The batch
// succeeds, but its caller has to wait as if all of it had been refused.
absl::Status RefusalWithin(const v1::ActBatchResponse& response) {
  for (const v1::ActResult& result : response.results()) {
    if (result.code() == static_cast<int>(absl::StatusCode::kResourceExhausted)) {
      return absl::ResourceExhaustedError(result.message());
    }
  }
  return absl::OkStatus();
}

}  // namespace

void ActCall::Handle() {
  const auto self = std::static_pointer_cast<ActCall>(shared_from_this());
  queue_.Add({.client = self,
              .messages = std::shared_ptr<ActMessages>(self, &messages()),
              .caller = &caller(),
              .request_bytes = 0,  // the call knows its own
              .received = context().clock->Now()});
}

void ActCall::OnDecided(ActMessages& /*messages*/, const absl::Status& status,
                        size_t /*request_bytes*/, absl::Duration /*received*/) {
  End(status);
}

void ActBatchCall::Handle() {
  auto status = PolicyHandler::CheckBatch(request());
  if (status.ok() && request().requests().empty()) {  // otherwise its requests count
    status = caller().tenant()->AcquireDecision(context().clock->Now());
  }
  // Counted before the first decision: a batch that was decided must be answered.
  if (status.ok()) status = HoldMessages(request().requests_size() * kAnswerBytes);
  if (!status.ok()) return End(status);
  decided_ = 0;
  received_at_ = context().clock->Now();
  queue_.AddBatch(std::static_pointer_cast<ActBatchCall>(shared_from_this()));
}

bool ActBatchCall::DecideGroup(const PolicyHandler& handler, DeferredWork* deferred) {
  if (call() == nullptr) return true;
  decided_ = handler.ActBatchGroup(caller(), request(), decided_, response(), deferred, commits(),
                                   may_claim(), received_at_);
  if (decided_ < request().requests_size()) return false;
  EndWhenDurable({absl::OkStatus(), RefusalWithin(*response())});
  return true;
}

void ActStreamCall::HandleMessage(absl::string_view message) {
  const absl::Duration received = context().clock->Now();
  auto messages = std::make_shared<ActMessages>();
  if (auto status = ParseRequest(message, messages->request()); !status.ok()) {
    return Finish(status);
  }
  // The next request of a tenant with a limit must wait if this one is refused.
  limited_ = caller().tenant()->limits_decisions();
  if (CountRequest(message.size()) >= kMaxInProgress || limited_) call()->PauseReading();
  auto status = CheckStillAdmitted(caller(), static_cast<int64_t>(message.size()),
                                   context().max_message_bytes);
  if (status.ok() && !HoldRequests()) status = TooManyBytesError();
  if (!status.ok()) return OnDecided(*messages, status, message.size(), received);
  queue_.Add({.client = std::static_pointer_cast<ActStreamCall>(shared_from_this()),
              .messages = std::move(messages),
              .caller = &caller(),
              .request_bytes = message.size(),
              .received = received});
}

size_t ActStreamCall::CountRequest(size_t bytes) {
  in_progress_bytes_ += bytes;
  return ++in_progress_;
}

bool ActStreamCall::HoldRequests() {
  return call()->Hold(
      static_cast<int64_t>(in_progress_ * sizeof(ActMessages) + in_progress_bytes_));
}

void ActStreamCall::HandleTooLong(size_t length, const absl::Status& error) {
  ActMessages unread;
  CountRequest(length);
  OnDecided(unread, error, length, context().clock->Now());
}

void ActStreamCall::OnGranted() {
  if (!std::exchange(limited_, false) || call() == nullptr) return;
  if (in_progress_ < kMaxInProgress && !is_delayed()) call()->ResumeReading();
}

void ActStreamCall::OnDecided(ActMessages& messages, const absl::Status& status,
                              size_t request_bytes, absl::Duration received) {
  Observe(status, received);
  --in_progress_;
  in_progress_bytes_ -= request_bytes;
  if (call() == nullptr) return;
  HoldRequests();
  if (!status.ok()) ErrorToProto(*messages.request(), status, messages.response());
  call()->Send(*messages.response());
  PauseAfter(status, request_bytes);
  if (in_progress_ == 0 && !is_delayed()) call()->ResumeReading();
  FinishIfDone();
}

void ActStreamCall::FinishIfDone() {
  if (in_progress_ > 0 || !(half_closed_ || draining_)) return;
  Finish(half_closed_ ? absl::OkStatus() : CallGate::DrainingError());
}

void ActStreamCall::HandleHalfClose() {
  half_closed_ = true;
  FinishIfDone();
}

void ActStreamCall::OnDrain() {
  ServiceCall::OnDrain();
  draining_ = true;
  FinishIfDone();
}

}  // namespace spikeserve
