#include "server/unary_call.h"

#include "server/status_map.h"

namespace spikeserve {
namespace {

// Keeps a unary call on the books until gRPC has sent its answer. gRPC sends once the method has
// returned, so what may wait is done in OnDone.
class UnaryCall final : public grpc::ServerUnaryReactor {
 public:
  explicit UnaryCall(CallTracker* calls) : calls_(calls), accepted_(calls->Begin()) {}

  bool accepted() const { return accepted_; }
  DeferredWork* deferred() { return &deferred_; }

  void OnDone() override {
    deferred_.Run();
    calls_->End();
    delete this;  // gRPC's reactors own themselves
  }

 private:
  CallTracker* const calls_;
  const bool accepted_;
  DeferredWork deferred_;
};

}  // namespace

grpc::ServerUnaryReactor* AnswerUnary(const ServiceParts& parts, Method method,
                                      absl::FunctionRef<absl::Status(DeferredWork*)> handle) {
  const absl::Duration start = parts.clock->Now();
  auto* call = new UnaryCall(parts.calls);
  const absl::Status status = call->accepted() ? handle(call->deferred()) : DrainingError();
  parts.metrics->ObserveRpc(method, status.code(), parts.clock->Now() - start);
  call->Finish(ToGrpcStatus(status));
  return call;
}

}  // namespace spikeserve
