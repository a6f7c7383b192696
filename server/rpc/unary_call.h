// One unary call on gRPC's callback API, on the books of the server from its start to its end.
#ifndef SERVER_RPC_UNARY_CALL_H_
#define SERVER_RPC_UNARY_CALL_H_

#include <google/protobuf/message_lite.h>
#include <grpcpp/server_context.h>
#include <grpcpp/support/server_callback.h>

#include <functional>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "server/access/authenticator.h"
#include "server/agent/request_handler.h"
#include "server/rpc/service_parts.h"

namespace spikeserve {

// Answers a call with the status of `handle`, which fills in the response, or refuses it where the
// server drains or the caller may not make it; records it. `parts` must outlive the call. What
// `handle` defers is done once the answer has been sent.
grpc::ServerUnaryReactor* AnswerUnary(
    const ServiceParts& parts, const grpc::CallbackServerContext& context, Method method,
    const google::protobuf::MessageLite& request,
    absl::FunctionRef<absl::Status(const Credential& caller, DeferredWork*)> handle);

// The same for a call that takes long: `handle` runs on the background worker, or the call is
// refused with UNAVAILABLE.
grpc::ServerUnaryReactor* AnswerUnaryInBackground(
    const ServiceParts& parts, const grpc::CallbackServerContext& context, Method method,
    const google::protobuf::MessageLite& request,
    std::function<absl::Status(const Credential& caller)> handle);

}  // namespace spikeserve

#endif  // SERVER_RPC_UNARY_CALL_H_
