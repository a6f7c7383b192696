#include "server/act_stream.h"

#include "server/admission.h"
#include "server/convert.h"

namespace spikeserve {

absl::Status ActStream::Handle(const v1::ActRequest& request, v1::ActResponse* response,
                               DeferredWork* deferred) {
  const Credential& caller = **caller_;
  if (auto status = CheckStillAdmitted(caller, request, parts_.max_message_bytes); !status.ok()) {
    return status;
  }
  return parts_.handler->Act(caller, request, response, deferred);
}

absl::Status ActStream::Answer(const v1::ActRequest& request, v1::ActResponse* response,
                               DeferredWork* deferred) {
  const absl::Duration start = parts_.clock->Now();
  const absl::Status status = Handle(request, response, deferred);
  if (!status.ok()) ErrorToProto(request, status, response);
  parts_.metrics->ObserveRpc(Method::kActStream, status.code(), parts_.clock->Now() - start);
  return status;
}

}  // namespace spikeserve
