#include "server/rpc/act_stream.h"

#include "server/access/admission.h"
#include "server/agent/convert.h"

namespace spikeserve {

absl::Status ActStream::Handle(const v1::ActRequest& request, v1::ActResponse* response,
                               DeferredWork* deferred) {
  if (auto status = CheckStillAdmitted(caller(), static_cast<int64_t>(request.ByteSizeLong()),
                                       parts().max_message_bytes);
      !status.ok()) {
    return status;
  }
  return handler_->Act(caller(), request, response, deferred);
}

absl::Status ActStream::Answer(const v1::ActRequest& request, v1::ActResponse* response,
                               DeferredWork* deferred) {
  const absl::Duration start = parts().clock->Now();
  const absl::Status status = Handle(request, response, deferred);
  if (!status.ok()) ErrorToProto(request, status, response);
  parts().metrics->ObserveRpc(Method::kActStream, status.code(), parts().clock->Now() - start);
  return status;
}

}  // namespace spikeserve
