// Forwards the methods of a service to its handler.
//
// A handler method returns absl::Status and takes (request, response), (caller, request, response)
// or (caller, request, response, deferred work):
//
//   return Forward(parts_, Method::kAct, context, request, response, handler_,
//   &PolicyHandler::Act);
#ifndef SERVER_RPC_FORWARD_H_
#define SERVER_RPC_FORWARD_H_

#include <grpcpp/server_context.h>
#include <grpcpp/support/server_callback.h>

#include <type_traits>

#include "absl/status/status.h"
#include "server/rpc/unary_call.h"

namespace spikeserve {

// Calls `handler.*call` with the arguments that its form takes.
template <typename Handler, typename Call, typename Request, typename Response>
absl::Status Invoke(Handler& handler, Call call, const Credential& caller, const Request& request,
                    Response* response, DeferredWork* deferred) {
  if constexpr (std::is_invocable_v<Call, Handler&, const Request&, Response*>) {
    return (handler.*call)(request, response);
  } else if constexpr (std::is_invocable_v<Call, Handler&, const Credential&, const Request&,
                                           Response*>) {
    return (handler.*call)(caller, request, response);
  } else {
    return (handler.*call)(caller, request, response, deferred);
  }
}

// Answers the call with `handler.*call`. `parts` and `handler` must outlive the call.
template <typename Handler, typename Call, typename Request, typename Response>
grpc::ServerUnaryReactor* Forward(const ServiceParts& parts, Method method,
                                  const grpc::CallbackServerContext* context,
                                  const Request* request, Response* response, Handler* handler,
                                  Call call) {
  return AnswerUnary(parts, *context, method, *request,
                     [=](const Credential& caller, DeferredWork* deferred) -> CallOutcome {
                       return Invoke(*handler, call, caller, *request, response, deferred);
                     });
}

// As Forward, but runs `handler.*call` on the background worker. For methods that take long.
template <typename Handler, typename Call, typename Request, typename Response>
grpc::ServerUnaryReactor* ForwardInBackground(const ServiceParts& parts, Method method,
                                              const grpc::CallbackServerContext* context,
                                              const Request* request, Response* response,
                                              Handler* handler, Call call) {
  return AnswerUnaryInBackground(parts, *context, method, *request, [=](const Credential& caller) {
    return Invoke(*handler, call, caller, *request, response, /*deferred=*/nullptr);
  });
}

}  // namespace spikeserve

#endif  // SERVER_RPC_FORWARD_H_
