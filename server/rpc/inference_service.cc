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
    if (auto status = CheckStillAdmitted(caller(), request, parts().max_message_bytes);
        !status.ok()) {
      return status;
    }
    return handler_->ModelInfer(caller(), request, answer, deferred);
  }

  InferenceHandler* const handler_;
};

}  // namespace

grpc::ServerUnaryReactor* InferenceService::ServerLive(grpc::CallbackServerContext* context,
                                                       const inference::ServerLiveRequest* request,
                                                       inference::ServerLiveResponse* response) {
  return AnswerUnary(parts_, *context, Method::kServerLive, *request,
                     [&](const Credential&, DeferredWork*) {
                       response->set_live(true);
                       return absl::OkStatus();
                     });
}

grpc::ServerUnaryReactor* InferenceService::ServerReady(
    grpc::CallbackServerContext* context, const inference::ServerReadyRequest* request,
    inference::ServerReadyResponse* response) {
  return AnswerUnary(parts_, *context, Method::kServerReady, *request,
                     [&](const Credential&, DeferredWork*) {
                       response->set_ready(true);
                       return absl::OkStatus();
                     });
}

grpc::ServerUnaryReactor* InferenceService::ModelReady(grpc::CallbackServerContext* context,
                                                       const inference::ModelReadyRequest* request,
                                                       inference::ModelReadyResponse* response) {
  return AnswerUnary(
      parts_, *context, Method::kModelReady, *request,
      [&](const Credential&, DeferredWork*) { return handler_->ModelReady(*request, response); });
}

grpc::ServerUnaryReactor* InferenceService::ServerMetadata(
    grpc::CallbackServerContext* context, const inference::ServerMetadataRequest* request,
    inference::ServerMetadataResponse* response) {
  return AnswerUnary(parts_, *context, Method::kServerMetadata, *request,
                     [&](const Credential&, DeferredWork*) {
                       return handler_->ServerMetadata(*request, response);
                     });
}

grpc::ServerUnaryReactor* InferenceService::ModelMetadata(
    grpc::CallbackServerContext* context, const inference::ModelMetadataRequest* request,
    inference::ModelMetadataResponse* response) {
  return AnswerUnary(parts_, *context, Method::kModelMetadata, *request,
                     [&](const Credential&, DeferredWork*) {
                       return handler_->ModelMetadata(*request, response);
                     });
}

grpc::ServerUnaryReactor* InferenceService::ModelInfer(grpc::CallbackServerContext* context,
                                                       const inference::ModelInferRequest* request,
                                                       inference::ModelInferResponse* response) {
  return AnswerUnary(parts_, *context, Method::kModelInfer, *request,
                     [&](const Credential& caller, DeferredWork* deferred) {
                       return handler_->ModelInfer(caller, *request, response, deferred);
                     });
}

grpc::ServerBidiReactor<inference::ModelInferRequest, inference::ModelStreamInferResponse>*
InferenceService::ModelStreamInfer(grpc::CallbackServerContext* context) {
  return InferenceStream::Begin(std::make_shared<ModelInferStream>(
      parts_, Admit(*parts_.authenticator, *context, Method::kModelStreamInfer), handler_));
}

grpc::ServerUnaryReactor* InferenceService::ModelConfig(
    grpc::CallbackServerContext* context, const inference::ModelConfigRequest* request,
    inference::ModelConfigResponse* response) {
  return AnswerUnary(
      parts_, *context, Method::kModelConfig, *request,
      [&](const Credential&, DeferredWork*) { return handler_->ModelConfig(*request, response); });
}

grpc::ServerUnaryReactor* InferenceService::ModelStatistics(
    grpc::CallbackServerContext* context, const inference::ModelStatisticsRequest* request,
    inference::ModelStatisticsResponse* response) {
  return AnswerUnary(parts_, *context, Method::kModelStatistics, *request,
                     [&](const Credential&, DeferredWork*) {
                       return handler_->ModelStatistics(*request, response);
                     });
}

grpc::ServerUnaryReactor* InferenceService::RepositoryIndex(
    grpc::CallbackServerContext* context, const inference::RepositoryIndexRequest* request,
    inference::RepositoryIndexResponse* response) {
  return AnswerUnary(parts_, *context, Method::kRepositoryIndex, *request,
                     [&](const Credential&, DeferredWork*) {
                       return handler_->RepositoryIndex(*request, response);
                     });
}

grpc::ServerUnaryReactor* InferenceService::RepositoryModelLoad(
    grpc::CallbackServerContext* context, const inference::RepositoryModelLoadRequest* request,
    inference::RepositoryModelLoadResponse* response) {
  return AnswerUnaryInBackground(
      parts_, *context, Method::kRepositoryModelLoad, *request,
      [=, this](const Credential&) { return handler_->RepositoryModelLoad(*request, response); });
}

grpc::ServerUnaryReactor* InferenceService::RepositoryModelUnload(
    grpc::CallbackServerContext* context, const inference::RepositoryModelUnloadRequest* request,
    inference::RepositoryModelUnloadResponse* response) {
  return AnswerUnaryInBackground(
      parts_, *context, Method::kRepositoryModelUnload, *request,
      [=, this](const Credential&) { return handler_->RepositoryModelUnload(*request, response); });
}

}  // namespace spikeserve
