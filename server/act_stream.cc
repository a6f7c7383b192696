#include "server/act_stream.h"

#include "server/convert.h"

namespace spikeserve {

void ActStream::Answer(const v1::ActRequest& request, v1::ActResponse* response,
                       DeferredWork* deferred) {
  const absl::Duration start = parts_.clock->Now();
  const absl::Status status = parts_.handler->Act(request, response, deferred);
  if (!status.ok()) ErrorToProto(request, status, response);
  parts_.metrics->ObserveRpc(Method::kActStream, status.code(), parts_.clock->Now() - start);
}

}  // namespace spikeserve
