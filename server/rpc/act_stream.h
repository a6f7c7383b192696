// Answers one ActStream call.
#ifndef SERVER_RPC_ACT_STREAM_H_
#define SERVER_RPC_ACT_STREAM_H_

#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/agent/policy_handler.h"
#include "server/rpc/answer_stream.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Answers each request with PolicyHandler::Act. Thread-safety: see AnswerStream.
class ActStream final : public AnswerStream<v1::ActRequest, v1::ActResponse> {
 public:
  // `handler` must outlive the call.
  ActStream(const ServiceParts& parts, absl::StatusOr<const Credential*> caller,
            const PolicyHandler* handler)
      : AnswerStream(parts, std::move(caller)), handler_(handler) {}

 protected:
  absl::Status Answer(const v1::ActRequest& request, v1::ActResponse* response,
                      DeferredWork* deferred) override;

 private:
  absl::Status Handle(const v1::ActRequest& request, v1::ActResponse* response,
                      DeferredWork* deferred);

  const PolicyHandler* const handler_;
};

}  // namespace spikeserve

#endif  // SERVER_RPC_ACT_STREAM_H_
