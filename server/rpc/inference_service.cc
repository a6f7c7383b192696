#include "server/rpc/inference_service.h"

#include <memory>
#include <utility>

#include "server/access/admission.h"
#include "server/rpc/answer_stream.h"
#include "server/rpc/unary_call.h"

namespace spikeserve {
namespace {

using InferenceStream =
    AnswerStream<inference::ModelInferRequest, inference::ModelStreamInferResponse>;

class ModelInferStream final : public InferenceStream {
 public:
  ModelInferStream(const ServiceParts& parts, absl::StatusOr<const Credential*> caller,
                   InferenceHandler* handler)
      : InferenceStream(parts, std::move(caller)), handler_(handler) {}

 protected:
  absl::Status Answer(const inference::ModelInferRequest& request,
                      inference::ModelStreamInferResponse* response,
                      DeferredWork* deferred) override {
    const absl::Duration start = parts().clock->Now();
    auto* answer = response->mutable_infer_response();
    const absl::Status status = Handle(request, answer, deferred);
    if (!status.ok()) {
      response->set_error_message(std::string(status.message()));
      answer->Clear();
      answer->set_id(request.id());
    }
    parts().metrics->ObserveRpc(Method::kModelStreamInfer, status.code(),
                                parts().clock->Now() - start);
    return status;
  }

 private:
  absl::Status Handle(const inference::ModelInferRequest& request,
                      inference::ModelInferResponse* answer, DeferredWork* deferred) {
    if (auto status = CheckStillAdmitted(caller(), static_cast<int64_t>(request.ByteSizeLong()),
                                         parts().max_message_bytes);
        !status.ok()) {
      return status;
    }
    return handler_->ModelInfer(caller(), request, answer, deferred);
  }

  InferenceHandler* const handler_;
};

}  // namespace

grpc::ServerBidiReactor<inference::ModelInferRequest, inference::ModelStreamInferResponse>*
InferenceService::ModelStreamInfer(grpc::CallbackServerContext* context) {
  return InferenceStream::Begin(std::make_shared<ModelInferStream>(
      parts_, AdmitCaller(parts_, *context, Method::kModelStreamInfer), handler_));
}

}  // namespace spikeserve
