#include "server/services/act_calls.h"

#include <algorithm>
#include <iterator>
#include <utility>

#include "server/access/admission.h"
#include "server/messages/convert.h"
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

// One request of the stream. Keeps the call alive, and the requests of its session behind it that
// are answered before it: requests of a session that moves do not wait for the same.
class ActStreamCall::Item final : public QueuedAct,
                                  public GatedRequest,
                                  public std::enable_shared_from_this<Item> {
 public:
  Item(std::shared_ptr<ActStreamCall> call, size_t request_bytes, absl::Duration received)
      : call_(std::move(call)), request_bytes_(request_bytes), received_(received) {}
  // At the end of the server, a request may have no answer.
  ~Item() override { call_->TakeOut(*this); }

  Messages& messages() { return messages_; }
  const std::string& session_id() { return messages_.request()->session_id(); }

  void Handle() {
    act().context = &call_context();
    act().request = messages_.request();
    act().response = messages_.response();
    act().received = received_;
    act().step = {};
    call_->queue_.Add(shared_from_this());
  }
  void OnDecided() override { call_->context().sessions->Leave(*this, act().status); }

  std::shared_ptr<GatedRequest> Self() override { return shared_from_this(); }
  SessionRecovery::Post post() override { return PostTo(&call_->loop()); }
  // A decision is made and stored whether its caller waits for it or not.
  bool is_over() override { return false; }
  void OnGranted() override { call_->OnGranted(); }
  void Answer(const absl::Status& status) override {
    call_->EndSpan(status, &call_context().span);
    status_ = status;
    Item* const earlier = call_->TakeOut(*this);
    if (earlier != nullptr) return earlier->behind_.push_back(shared_from_this());
    Send();
  }

 private:
  void Send() {
    call_->Answer(messages_, status_, request_bytes_, received_, act().policy);
    for (const auto& item : std::exchange(behind_, {})) item->Send();
  }

  const std::shared_ptr<ActStreamCall> call_;
  const size_t request_bytes_;
  const absl::Duration received_;  // time of the server's clock
  Messages messages_;
  absl::Status status_;                        // of the answer
  std::vector<std::shared_ptr<Item>> behind_;  // their answers wait for this one
};

void ActOneCall::Handle() {
  act().context = &call_context();
  act().request = &request();
  act().response = response();
  act().received = context().clock->Now();
  act().step = {};
  queue_.Add(std::static_pointer_cast<ActOneCall>(shared_from_this()));
}

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
  response()->Clear();
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

void ActStreamCall::HandleMessage(absl::string_view message) {
  const absl::Duration received = context().clock->Now();
  const auto item = std::make_shared<Item>(
      std::static_pointer_cast<ActStreamCall>(shared_from_this()), message.size(), received);
  if (auto status = ParseRequest(message, item->messages().request()); !status.ok()) {
    return Finish(status);
  }
  item->call_context().span = StartSpan(TraceOf(*item->messages().request(), *call()));
  waiting_.push_back(item.get());
  // The next request of a tenant with a limit must wait if this one is refused.
  limited_ = caller().tenant()->limits_decisions();
  if (CountRequest(message.size()) >= kMaxInProgress || limited_) call()->PauseReading();
  auto status = CheckStillAdmitted(caller(), static_cast<int64_t>(message.size()),
                                   context().max_message_bytes);
  if (status.ok() && !HoldRequests()) status = TooManyBytesError();
  if (!status.ok()) return item->Answer(status);
  item->call_context().caller = &caller();
  context().sessions->Enter(&item->call_context());
  item->Handle();
}

ActStreamCall::Item* ActStreamCall::TakeOut(const Item& item) {
  const auto at = std::find(waiting_.begin(), waiting_.end(), &item);
  if (at == waiting_.end()) return nullptr;
  const auto earlier =
      std::find_if(std::make_reverse_iterator(at), waiting_.rend(),
                   [&](Item* waiting) { return waiting->session_id() == (*at)->session_id(); });
  Item* const last = earlier == waiting_.rend() ? nullptr : *earlier;
  waiting_.erase(at);
  return last;
}

size_t ActStreamCall::CountRequest(size_t bytes) {
  in_progress_bytes_ += bytes;
  return ++in_progress_;
}

bool ActStreamCall::HoldRequests() {
  return call()->Hold(static_cast<int64_t>(in_progress_ * sizeof(Messages) + in_progress_bytes_));
}

void ActStreamCall::HandleTooLong(size_t length, const absl::Status& error) {
  Messages unread;
  CountRequest(length);
  Answer(unread, error, length, context().clock->Now(), "");
}

void ActStreamCall::OnGranted() {
  if (!std::exchange(limited_, false) || call() == nullptr) return;
  if (in_progress_ < kMaxInProgress && !is_delayed()) call()->ResumeReading();
}

void ActStreamCall::Answer(Messages& messages, const absl::Status& status, size_t request_bytes,
                           absl::Duration received, absl::string_view policy) {
  Observe(status, received, policy);
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
