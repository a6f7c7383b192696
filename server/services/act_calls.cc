#include "server/services/act_calls.h"

#include <algorithm>
#include <iterator>
#include <utility>

#include "server/access/admission.h"
#include "server/messages/step_convert.h"
#include "server/services/request_parser.h"
#include "server/transport/limits.h"

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

// Returns the caller's span that a request of a stream belongs to.
TraceParent TraceOf(const v1::ActRequest& request, const Call& call) {
  if (request.traceparent().empty()) return call.head().trace;
  const TraceParent own = ParseTraceParent(request.traceparent());
  return own.is_valid() ? own : call.head().trace;
}

// Returns true if the item found no session.
bool IsMissing(const v1::ActResult& result) {
  return result.code() == static_cast<int>(absl::StatusCode::kNotFound);
}

}  // namespace

void ActBatchCall::Handle() {
  auto status = PolicyHandler::CheckBatch(request());
  // Otherwise its requests count.
  if (status.ok() && request().requests().empty() && !call_context().has_paid) {
    status = caller().tenant()->AcquireDecision(context().clock->Now());
  }
  // Counted before the first decision: a batch that was decided must be answered.
  if (status.ok()) status = HoldMessages(request().requests_size() * kAnswerBytes);
  if (!status.ok()) return End(status);
  decided_ = 0;
  received_at_ = context().clock->Now();
  progress_ = {};
  queue_.AddBatch(std::static_pointer_cast<ActBatchCall>(shared_from_this()));
}

bool ActBatchCall::DecideGroup(const PolicyHandler& handler, DeferredWork* deferred,
                               StepBudget* budget) {
  if (call() == nullptr) return true;
  call_context().deferred = deferred;
  decided_ = handler.ActBatchGroup(call_context(), request(), decided_, response(), received_at_,
                                   &progress_, budget);
  if (decided_ < request().requests_size()) return false;
  refusal_ = RefusalWithin(*response());
  ExplainMissing();
  Leave(absl::OkStatus());
  return true;
}

std::vector<std::string> ActBatchCall::MissingSessions(const absl::Status& /*status*/) {
  std::vector<std::string> missing;
  for (int i = 0; i < response()->results_size(); ++i) {
    if (IsMissing(response()->results(i))) missing.push_back(request().requests(i).session_id());
  }
  return missing;
}

void ActBatchCall::HandleAgain(const std::map<std::string, absl::Status>& unclaimed) {
  unclaimed_ = unclaimed;
  for (v1::ActResult& result : *response()->mutable_results()) {
    if (IsMissing(result)) result.Clear();
  }
  Handle();
}

void ActBatchCall::ExplainMissing() {
  if (!call_context().has_claimed) return;
  for (int i = 0; i < response()->results_size(); ++i) {
    if (!IsMissing(response()->results(i))) continue;
    const auto reason = unclaimed_.find(request().requests(i).session_id());
    FailItem(i, reason == unclaimed_.end() ? SessionGate::MovedError() : reason->second);
  }
}

void ActBatchCall::FailItem(int item, const absl::Status& status) {
  ErrorToProto(status, response()->mutable_results(item));
}

// One request of the call. Keeps the call alive, and the requests of its session behind it that are
// decided before it: requests of a session that moves do not wait for the same.
class ActCall::Item final : public QueuedAct {
 public:
  Item(std::shared_ptr<ActCall> call, size_t bytes)
      : QueuedAct(&call->context(), &call->queue_), call_(std::move(call)), bytes_(bytes) {}
  // At the end of the server, a request may have no answer.
  ~Item() override { call_->TakeOut(*this); }

  size_t bytes() const { return bytes_; }  // as it arrived

  void OnGranted() override { call_->OnGranted(); }

 private:
  void Send(const absl::Status& status) override {
    call_->EndSpan(status, &call_context().span);
    status_ = status;
    Item* const earlier = call_->TakeOut(*this);
    if (earlier != nullptr) {
      return earlier->behind_.push_back(std::static_pointer_cast<Item>(shared_from_this()));
    }
    SendInOrder();
  }
  void SendInOrder() {
    call_->Send(*this, status_);
    for (const auto& item : std::exchange(behind_, {})) item->SendInOrder();
  }

  const std::shared_ptr<ActCall> call_;
  const size_t bytes_;
  absl::Status status_;                        // of the answer
  std::vector<std::shared_ptr<Item>> behind_;  // their answers wait for this one
};

std::shared_ptr<ActCall::Item> ActCall::NewItem(size_t bytes) {
  has_request_ = true;
  ++in_progress_;
  in_progress_bytes_ += bytes;
  return std::make_shared<Item>(std::static_pointer_cast<ActCall>(shared_from_this()), bytes);
}

void ActCall::HandleMessage(absl::string_view message) {
  if (!method().streams && has_request_) {
    if (is_delayed()) return;
    return Finish(absl::InternalError("message: expected one request, received a second one"));
  }
  const auto item = NewItem(message.size());
  const auto admitted = CheckStillAdmitted(caller(), static_cast<int64_t>(message.size()),
                                           context().max_message_bytes);
  // On a stream the answer of a refusal has the session, too.
  const bool parses = admitted.ok() || method().streams;
  auto status = parses ? ParseRequest(message, item->request()) : admitted;
  // The answer on a stream would lack the session.
  if (!status.ok() && method().streams) return Finish(status);
  item->call_context().span = StartSpan(TraceOf(*item->request(), *call()));
  waiting_.push_back(item.get());
  if (method().streams) {
    // The next request of a tenant with a limit must wait if this one is refused.
    limited_ = caller().tenant()->limits_decisions();
    if (in_progress_ >= kMaxInProgress || limited_) call()->PauseReading();
  } else {
    item->call_context().has_paid = call()->head().admitted != nullptr;
  }
  if (status.ok()) status = admitted;
  if (status.ok() && !HoldRequests()) status = TooManyBytesError();
  status.ok() ? item->Enter(&caller()) : item->Answer(status);
}

void ActCall::HandleTooLong(size_t length, const absl::Status& error) {
  if (method().streams || !has_request_) NewItem(length)->Answer(error);
}

ActCall::Item* ActCall::TakeOut(const Item& item) {
  const auto at = std::find(waiting_.begin(), waiting_.end(), &item);
  if (at == waiting_.end()) return nullptr;
  const auto is_of_session = [&](Item* waiting) {
    return waiting->request()->session_id() == (*at)->request()->session_id();
  };
  const auto earlier = std::find_if(std::make_reverse_iterator(at), waiting_.rend(), is_of_session);
  Item* const last = earlier == waiting_.rend() ? nullptr : *earlier;
  waiting_.erase(at);
  return last;
}

bool ActCall::HoldRequests() {
  return call()->Hold(static_cast<int64_t>(in_progress_ * QueuedAct::kBytes + in_progress_bytes_));
}

void ActCall::OnGranted() {
  if (!std::exchange(limited_, false) || call() == nullptr) return;
  if (in_progress_ < kMaxInProgress && !is_delayed()) call()->ResumeReading();
}

void ActCall::Send(Item& item, const absl::Status& status) {
  Observe(status, item.act().received, item.act().policy);
  --in_progress_;
  in_progress_bytes_ -= item.bytes();
  if (call() == nullptr) return;
  HoldRequests();
  if (!method().streams) {
    if (status.ok()) call()->Send(*item.response());
    return AfterDelay(status, item.bytes(), [this, status] { Finish(status); });
  }
  if (!status.ok()) ErrorToProto(*item.request(), status, item.response());
  call()->Send(*item.response());
  PauseAfter(status, item.bytes());
  if (in_progress_ == 0 && !is_delayed()) call()->ResumeReading();
  FinishIfDone();
}

void ActCall::FinishIfDone() {
  if (!method().streams || in_progress_ > 0 || !(half_closed_ || draining_)) return;
  Finish(half_closed_ ? absl::OkStatus() : CallGate::DrainingError());
}

void ActCall::HandleHalfClose() {
  half_closed_ = true;
  if (!method().streams && !has_request_) {
    return Finish(absl::InternalError("message: expected one request, received none"));
  }
  FinishIfDone();
}

void ActCall::OnDrain() {
  ServiceCall::OnDrain();
  draining_ = true;
  FinishIfDone();
}

}  // namespace spikeserve
