#include "server/services/infer_stream_call.h"

#include "server/access/admission.h"
#include "server/services/request_parser.h"

namespace spikeserve {

absl::Status InferStreamCall::Answer(const inference::ModelInferRequest& request,
                                     size_t request_bytes,
                                     inference::ModelInferResponse* response) {
  const auto status = CheckStillAdmitted(caller(), static_cast<int64_t>(request_bytes),
                                         context().max_message_bytes);
  return status.ok() ? handler_.ModelInfer(caller(), request, response, deferred_) : status;
}

void InferStreamCall::HandleMessage(absl::string_view message) {
  const absl::Duration start = context().clock->Now();
  inference::ModelInferRequest request;
  if (auto status = ParseRequest(message, &request); !status.ok()) return Finish(status);
  inference::ModelStreamInferResponse response;
  const absl::Status status = Answer(request, message.size(), response.mutable_infer_response());
  Observe(status, start);
  Reply(status, request.id(), message.size(), &response);
}

void InferStreamCall::HandleTooLong(size_t length, const absl::Status& error) {
  Observe(error, context().clock->Now());
  inference::ModelStreamInferResponse response;
  Reply(error, /*id=*/"", length, &response);
}

void InferStreamCall::Reply(const absl::Status& status, const std::string& id, size_t request_bytes,
                            inference::ModelStreamInferResponse* response) {
  if (!status.ok()) {
    response->set_error_message(std::string(status.message()));
    response->mutable_infer_response()->Clear();
    response->mutable_infer_response()->set_id(id);
  }
  call()->Send(*response);
  PauseAfter(status, request_bytes);
}

}  // namespace spikeserve
