// One ActStream call.
#ifndef SERVER_RPC_ACT_STREAM_H_
#define SERVER_RPC_ACT_STREAM_H_

#include "absl/status/status.h"
#include "server/rpc/answer_stream.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Thread-safe as AnswerStream is.
class ActStream final : public AnswerStream<v1::ActRequest, v1::ActResponse> {
 public:
  using AnswerStream::AnswerStream;

 protected:
  absl::Status Answer(const v1::ActRequest& request, v1::ActResponse* response,
                      DeferredWork* deferred) override;

 private:
  absl::Status Handle(const v1::ActRequest& request, v1::ActResponse* response,
                      DeferredWork* deferred);
};

}  // namespace spikeserve

#endif  // SERVER_RPC_ACT_STREAM_H_
