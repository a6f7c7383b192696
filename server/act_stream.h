// One ActStream call.
#ifndef SERVER_ACT_STREAM_H_
#define SERVER_ACT_STREAM_H_

#include <utility>

#include "absl/status/statusor.h"
#include "server/answer_stream.h"
#include "server/authenticator.h"
#include "server/service_parts.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Thread-safe as AnswerStream is.
class ActStream final : public AnswerStream<v1::ActRequest, v1::ActResponse> {
 public:
  // `caller` is what Admit() said. A token that expires later fails the requests that come then.
  ActStream(const ServiceParts& parts, absl::StatusOr<const Credential*> caller)
      : parts_(parts), caller_(std::move(caller)) {}

 protected:
  absl::Status Answer(const v1::ActRequest& request, v1::ActResponse* response,
                      DeferredWork* deferred) override;

 private:
  // REQUIRES: the caller was admitted, or the call would have ended.
  absl::Status Handle(const v1::ActRequest& request, v1::ActResponse* response,
                      DeferredWork* deferred);

  const ServiceParts parts_;
  const absl::StatusOr<const Credential*> caller_;
};

}  // namespace spikeserve

#endif  // SERVER_ACT_STREAM_H_
