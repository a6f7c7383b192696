// inference.GRPCInferenceService (Open Inference Protocol v2) on gRPC's callback API. Forwards
// every method to InferenceHandler.
#ifndef SERVER_RPC_INFERENCE_SERVICE_H_
#define SERVER_RPC_INFERENCE_SERVICE_H_

#include "inference/grpc_service.grpc.pb.h"
#include "server/inference/inference_handler.h"
#include "server/rpc/forward.h"
#include "server/rpc/service_parts.h"

namespace spikeserve {

// Thread-safe.
class InferenceService final : public inference::GRPCInferenceService::CallbackService {
 public:
  // `handler` must outlive the service.
  InferenceService(const ServiceParts& parts, InferenceHandler* handler)
      : parts_(parts), handler_(handler) {}

  grpc::ServerUnaryReactor* ServerLive(grpc::CallbackServerContext* context,
                                       const inference::ServerLiveRequest* request,
                                       inference::ServerLiveResponse* response) override {
    return Forward(parts_, Method::kServerLive, context, request, response, handler_,
                   &InferenceHandler::ServerLive);
  }
  grpc::ServerUnaryReactor* ServerReady(grpc::CallbackServerContext* context,
                                        const inference::ServerReadyRequest* request,
                                        inference::ServerReadyResponse* response) override {
    return Forward(parts_, Method::kServerReady, context, request, response, handler_,
                   &InferenceHandler::ServerReady);
  }

  grpc::ServerUnaryReactor* ModelReady(grpc::CallbackServerContext* context,
                                       const inference::ModelReadyRequest* request,
                                       inference::ModelReadyResponse* response) override {
    return Forward(parts_, Method::kModelReady, context, request, response, handler_,
                   &InferenceHandler::ModelReady);
  }
  grpc::ServerUnaryReactor* ServerMetadata(grpc::CallbackServerContext* context,
                                           const inference::ServerMetadataRequest* request,
                                           inference::ServerMetadataResponse* response) override {
    return Forward(parts_, Method::kServerMetadata, context, request, response, handler_,
                   &InferenceHandler::ServerMetadata);
  }
  grpc::ServerUnaryReactor* ModelMetadata(grpc::CallbackServerContext* context,
                                          const inference::ModelMetadataRequest* request,
                                          inference::ModelMetadataResponse* response) override {
    return Forward(parts_, Method::kModelMetadata, context, request, response, handler_,
                   &InferenceHandler::ModelMetadata);
  }
  grpc::ServerUnaryReactor* ModelInfer(grpc::CallbackServerContext* context,
                                       const inference::ModelInferRequest* request,
                                       inference::ModelInferResponse* response) override {
    return Forward(parts_, Method::kModelInfer, context, request, response, handler_,
                   &InferenceHandler::ModelInfer);
  }
  grpc::ServerBidiReactor<inference::ModelInferRequest, inference::ModelStreamInferResponse>*
  ModelStreamInfer(grpc::CallbackServerContext* context) override;
  grpc::ServerUnaryReactor* ModelConfig(grpc::CallbackServerContext* context,
                                        const inference::ModelConfigRequest* request,
                                        inference::ModelConfigResponse* response) override {
    return Forward(parts_, Method::kModelConfig, context, request, response, handler_,
                   &InferenceHandler::ModelConfig);
  }
  grpc::ServerUnaryReactor* ModelStatistics(grpc::CallbackServerContext* context,
                                            const inference::ModelStatisticsRequest* request,
                                            inference::ModelStatisticsResponse* response) override {
    return Forward(parts_, Method::kModelStatistics, context, request, response, handler_,
                   &InferenceHandler::ModelStatistics);
  }
  grpc::ServerUnaryReactor* RepositoryIndex(grpc::CallbackServerContext* context,
                                            const inference::RepositoryIndexRequest* request,
                                            inference::RepositoryIndexResponse* response) override {
    return Forward(parts_, Method::kRepositoryIndex, context, request, response, handler_,
                   &InferenceHandler::RepositoryIndex);
  }
  grpc::ServerUnaryReactor* RepositoryModelLoad(
      grpc::CallbackServerContext* context, const inference::RepositoryModelLoadRequest* request,
      inference::RepositoryModelLoadResponse* response) override {
    return ForwardInBackground(parts_, Method::kRepositoryModelLoad, context, request, response,
                               handler_, &InferenceHandler::RepositoryModelLoad);
  }
  grpc::ServerUnaryReactor* RepositoryModelUnload(
      grpc::CallbackServerContext* context, const inference::RepositoryModelUnloadRequest* request,
      inference::RepositoryModelUnloadResponse* response) override {
    return ForwardInBackground(parts_, Method::kRepositoryModelUnload, context, request, response,
                               handler_, &InferenceHandler::RepositoryModelUnload);
  }

 private:
  const ServiceParts parts_;
  InferenceHandler* const handler_;
};

}  // namespace spikeserve

#endif  // SERVER_RPC_INFERENCE_SERVICE_H_
