// ModelStreamInfer of the Open Inference Protocol: any number of requests, each answered in order.
//
// Confined to the thread of the call's loop.
#pragma once

#include "absl/status/status.h"
#include "inference/grpc_service.pb.h"
#include "server/agent/decision_request.h"
#include "server/inference/inference_handler.h"
#include "server/services/service_call.h"

namespace spikeserve {

// A request that fails is answered with its error, and the stream continues.
class InferStreamCall final : public ServiceCall {
 public:
  // `deferred` is work that the loop does after it has sent the answers. All pointers must outlive
  // the call.
  InferStreamCall(const ServiceContext* context, Call* call, const Method& method,
                  const InferenceHandler* handler, DeferredWork* deferred)
      : ServiceCall(context, call, method), handler_(*handler), deferred_(deferred) {}

  void OnDrain() override {
    ServiceCall::OnDrain();
    Finish(CallGate::DrainingError());
  }

 private:
  class Item;

  void HandleMessage(absl::string_view message) override;
  void HandleTooLong(size_t length, const absl::Status& error) override;
  void HandleHalfClose() override { Finish(absl::OkStatus()); }
  // Sends an answer, or its error.
  void Reply(const absl::Status& status, const std::string& id, size_t request_bytes,
             inference::ModelStreamInferResponse* response);

  const InferenceHandler& handler_;
  DeferredWork* const deferred_;
};

}  // namespace spikeserve
