#include "server/services/infer_stream_call.h"

#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "server/access/admission.h"
#include "server/agent/session_gate.h"
#include "server/services/request_parser.h"

namespace spikeserve {
namespace {

// Returns the caller's span that a request of a stream belongs to: its own parameter `traceparent`,
// or else the header of the call.
TraceParent TraceOf(const inference::ModelInferRequest& request, const Call& call) {
  const auto it = request.parameters().find("traceparent");
  if (it == request.parameters().end()) return call.head().trace;
  const TraceParent own = ParseTraceParent(it->second.string_param());
  return own.is_valid() ? own : call.head().trace;
}

}  // namespace

// One request of the stream. Keeps the call alive.
class InferStreamCall::Item final : public GatedRequest, public std::enable_shared_from_this<Item> {
 public:
  Item(std::shared_ptr<InferStreamCall> call, size_t request_bytes)
      : call_(std::move(call)), request_bytes_(request_bytes), start_(Now()) {
    call_context().caller = &call_->caller();
    call_context().deferred = call_->deferred_;
    call_->context().sessions->Enter(&call_context());
  }

  inference::ModelInferRequest* request() { return &request_; }
  // The request was read, from a call that is not over.
  void StartSpan() { call_context().span = call_->StartSpan(TraceOf(request_, *call_->call())); }

  void Handle() {
    auto status = CheckStillAdmitted(call_->caller(), static_cast<int64_t>(request_bytes_),
                                     call_->context().max_message_bytes);
    if (status.ok()) {
      status =
          call_->handler_.ModelInfer(call_context(), request_, response_.mutable_infer_response());
    }
    call_->context().sessions->Leave(*this, status);
  }

  std::shared_ptr<GatedRequest> Self() override { return shared_from_this(); }
  SessionRecovery::Post post() override { return PostTo(&call_->loop()); }
  bool is_over() override { return call_->call() == nullptr; }
  // A sequence is not stored.
  std::vector<std::string> MissingSessions(const absl::Status& /*status*/) override { return {}; }
  void HandleAgain(const std::map<std::string, absl::Status>& /*unclaimed*/) override { Handle(); }
  void Answer(const absl::Status& status) override {
    call_->Observe(status, start_);
    call_->EndSpan(status, &call_context().span);
    call_->Reply(status, request_.id(), request_bytes_, &response_);
  }

 private:
  absl::Duration Now() const { return call_->context().clock->Now(); }

  const std::shared_ptr<InferStreamCall> call_;
  const size_t request_bytes_;
  const absl::Duration start_;  // time of the server's clock
  inference::ModelInferRequest request_;
  inference::ModelStreamInferResponse response_;
};

void InferStreamCall::HandleMessage(absl::string_view message) {
  const auto item = std::make_shared<Item>(
      std::static_pointer_cast<InferStreamCall>(shared_from_this()), message.size());
  if (auto status = ParseRequest(message, item->request()); !status.ok()) return Finish(status);
  item->StartSpan();
  item->Handle();
}

void InferStreamCall::HandleTooLong(size_t length, const absl::Status& error) {
  Observe(error, context().clock->Now());
  inference::ModelStreamInferResponse response;
  Reply(error, /*id=*/"", length, &response);
}

void InferStreamCall::Reply(const absl::Status& status, const std::string& id, size_t request_bytes,
                            inference::ModelStreamInferResponse* response) {
  if (call() == nullptr) return;
  if (!status.ok()) {
    response->set_error_message(std::string(status.message()));
    response->mutable_infer_response()->Clear();
    response->mutable_infer_response()->set_id(id);
  }
  call()->Send(*response);
  PauseAfter(status, request_bytes);
}

}  // namespace spikeserve
