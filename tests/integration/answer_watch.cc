#include "tests/integration/answer_watch.h"

#include <grpcpp/support/client_interceptor.h>

#include <algorithm>
#include <atomic>

#include "absl/strings/match.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {
namespace {

namespace interception = grpc::experimental;

std::atomic<int64_t> newest_step = -1;

class AnswerInterceptor final : public interception::Interceptor {
 public:
  explicit AnswerInterceptor(bool watches) : watches_(watches) {}

  void Intercept(interception::InterceptorBatchMethods* methods) override {
    using interception::InterceptionHookPoints;
    if (watches_ &&
        methods->QueryInterceptionHookPoint(InterceptionHookPoints::POST_RECV_MESSAGE)) {
      const auto* answer = static_cast<const v1::ActResponse*>(methods->GetRecvMessage());
      if (answer != nullptr && answer->has_action()) {
        newest_step = std::max<int64_t>(newest_step, answer->step());  // one thread at a time
      }
    }
    methods->Proceed();
  }

 private:
  const bool watches_;
};

class AnswerInterceptorFactory final : public interception::ClientInterceptorFactoryInterface {
 public:
  interception::Interceptor* CreateClientInterceptor(interception::ClientRpcInfo* call) override {
    return new AnswerInterceptor(absl::EndsWith(call->method(), "/ActStream"));  // gRPC owns it
  }
};

}  // namespace

void WatchAnswers() {
  static AnswerInterceptorFactory factory;
  interception::RegisterGlobalClientInterceptorFactory(&factory);
}

int64_t NewestAnswer() { return newest_step; }

}  // namespace spikeserve
