#include "server/inference_service.h"

#include <memory>

#include "server/unary_call.h"

namespace spikeserve {
namespace {

using InferenceStream =
    AnswerStream<inference::ModelInferRequest, inference::ModelStreamInferResponse>;

class ModelInferStream final : public InferenceStream {
 public:
  ModelInferStream(const ServiceParts& parts, InferenceHandler* handler)
      : parts_(parts), handler_(handler) {}

 protected:
  void Answer(const inference::ModelInferRequest& request,
              inference::ModelStreamInferResponse* response, DeferredWork* deferred) override {
    const absl::Duration start = parts_.clock->Now();
    auto* answer = response->mutable_infer_response();
    const absl::Status status = handler_->ModelInfer(request, answer, deferred);
    if (!status.ok()) {
      response->set_error_message(std::string(status.message()));
      answer->Clear();
      answer->set_id(request.id());
    }
    parts_.metrics->ObserveRpc(Method::kModelStreamInfer, status.code(),
                               parts_.clock->Now() - start);
  }

 private:
  const ServiceParts parts_;
  InferenceHandler* const handler_;
};

}  // namespace

grpc::ServerUnaryReactor* InferenceService::ServerLive(grpc::CallbackServerContext*,
                                                       const inference::ServerLiveRequest*,
                                                       inference::ServerLiveResponse* response) {
  return AnswerUnary(parts_, Method::kServerLive, [&](DeferredWork*) {
    response->set_live(true);
    return absl::OkStatus();
  });
}

grpc::ServerUnaryReactor* InferenceService::ServerReady(grpc::CallbackServerContext*,
                                                        const inference::ServerReadyRequest*,
                                                        inference::ServerReadyResponse* response) {
  return AnswerUnary(parts_, Method::kServerReady, [&](DeferredWork*) {
    response->set_ready(true);
    return absl::OkStatus();
  });
}

grpc::ServerUnaryReactor* InferenceService::ModelReady(grpc::CallbackServerContext*,
                                                       const inference::ModelReadyRequest* request,
                                                       inference::ModelReadyResponse* response) {
  return AnswerUnary(parts_, Method::kModelReady,
                     [&](DeferredWork*) { return handler_->ModelReady(*request, response); });
}

grpc::ServerUnaryReactor* InferenceService::ServerMetadata(
    grpc::CallbackServerContext*, const inference::ServerMetadataRequest* request,
    inference::ServerMetadataResponse* response) {
  return AnswerUnary(parts_, Method::kServerMetadata,
                     [&](DeferredWork*) { return handler_->ServerMetadata(*request, response); });
}

grpc::ServerUnaryReactor* InferenceService::ModelMetadata(
    grpc::CallbackServerContext*, const inference::ModelMetadataRequest* request,
    inference::ModelMetadataResponse* response) {
  return AnswerUnary(parts_, Method::kModelMetadata,
                     [&](DeferredWork*) { return handler_->ModelMetadata(*request, response); });
}

grpc::ServerUnaryReactor* InferenceService::ModelInfer(grpc::CallbackServerContext*,
                                                       const inference::ModelInferRequest* request,
                                                       inference::ModelInferResponse* response) {
  return AnswerUnary(parts_, Method::kModelInfer, [&](DeferredWork* deferred) {
    return handler_->ModelInfer(*request, response, deferred);
  });
}

grpc::ServerBidiReactor<inference::ModelInferRequest, inference::ModelStreamInferResponse>*
InferenceService::ModelStreamInfer(grpc::CallbackServerContext*) {
  return InferenceStream::Begin(std::make_shared<ModelInferStream>(parts_, handler_), parts_.calls);
}

grpc::ServerUnaryReactor* InferenceService::ModelConfig(
    grpc::CallbackServerContext*, const inference::ModelConfigRequest* request,
    inference::ModelConfigResponse* response) {
  return AnswerUnary(parts_, Method::kModelConfig,
                     [&](DeferredWork*) { return handler_->ModelConfig(*request, response); });
}

grpc::ServerUnaryReactor* InferenceService::ModelStatistics(
    grpc::CallbackServerContext*, const inference::ModelStatisticsRequest* request,
    inference::ModelStatisticsResponse* response) {
  return AnswerUnary(parts_, Method::kModelStatistics,
                     [&](DeferredWork*) { return handler_->ModelStatistics(*request, response); });
}

grpc::ServerUnaryReactor* InferenceService::RepositoryIndex(
    grpc::CallbackServerContext*, const inference::RepositoryIndexRequest* request,
    inference::RepositoryIndexResponse* response) {
  return AnswerUnary(parts_, Method::kRepositoryIndex,
                     [&](DeferredWork*) { return handler_->RepositoryIndex(*request, response); });
}

grpc::ServerUnaryReactor* InferenceService::RepositoryModelLoad(
    grpc::CallbackServerContext*, const inference::RepositoryModelLoadRequest* request,
    inference::RepositoryModelLoadResponse* response) {
  return AnswerUnary(parts_, Method::kRepositoryModelLoad, [&](DeferredWork*) {
    return handler_->RepositoryModelLoad(*request, response);
  });
}

grpc::ServerUnaryReactor* InferenceService::RepositoryModelUnload(
    grpc::CallbackServerContext*, const inference::RepositoryModelUnloadRequest* request,
    inference::RepositoryModelUnloadResponse* response) {
  return AnswerUnary(parts_, Method::kRepositoryModelUnload, [&](DeferredWork*) {
    return handler_->RepositoryModelUnload(*request, response);
  });
}

}  // namespace spikeserve
