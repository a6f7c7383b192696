#include "server/rpc/policy_service.h"

#include <memory>

#include "absl/status/status.h"
#include "server/rpc/act_stream.h"
#include "server/rpc/unary_call.h"

namespace spikeserve {
namespace {

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

grpc::ServerUnaryReactor* PolicyService::ActBatch(grpc::CallbackServerContext* context,
                                                  const v1::ActBatchRequest* request,
                                                  v1::ActBatchResponse* response) {
  return AnswerUnary(parts_, *context, Method::kActBatch, *request,
                     [=, this](const Credential& caller, DeferredWork* deferred) {
                       absl::Status status =
                           handler_->ActBatch(caller, *request, response, deferred);
                       if (!status.ok()) return CallOutcome(std::move(status));
                       return CallOutcome(absl::OkStatus(), RefusalWithin(*response));
                     });
}

grpc::ServerBidiReactor<v1::ActRequest, v1::ActResponse>* PolicyService::ActStream(
    grpc::CallbackServerContext* context) {
  return spikeserve::ActStream::Begin(std::make_shared<spikeserve::ActStream>(
      parts_, AdmitCaller(parts_, *context, Method::kActStream), handler_));
}

}  // namespace spikeserve
