// Runs one unary call on gRPC's callback API, from its admission to its answer.
#ifndef SERVER_RPC_UNARY_CALL_H_
#define SERVER_RPC_UNARY_CALL_H_

#include <google/protobuf/message_lite.h>
#include <grpcpp/server_context.h>
#include <grpcpp/support/server_callback.h>

#include <functional>
#include <utility>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/access/authenticator.h"
#include "server/agent/deferred_work.h"
#include "server/base/method_table.h"
#include "server/rpc/service_parts.h"

namespace spikeserve {

// How a call ended.
struct CallOutcome {
  // NOLINTNEXTLINE(google-explicit-constructor): a handler returns a plain status as its outcome.
  CallOutcome(absl::Status ended) : status(ended), refusal(std::move(ended)) {}
  CallOutcome(absl::Status ended, absl::Status refused)
      : status(std::move(ended)), refusal(std::move(refused)) {}

  absl::Status status;   // sent to the caller
  absl::Status refusal;  // decides how long the answer is delayed; a batch that succeeds may hold
                         // items that were refused
};

// Returns the caller of `method`, or why it is refused.
absl::StatusOr<const Credential*> AdmitCaller(const ServiceParts& parts,
                                              const grpc::CallbackServerContext& context,
                                              Method method);

// Answers a call with the outcome of `handle`, which fills in the response, and records it. Refuses
// the call if the server drains or the caller may not make it. `parts` must outlive the call. The
// work that `handle` defers is done after the answer has been sent.
grpc::ServerUnaryReactor* AnswerUnary(
    const ServiceParts& parts, const grpc::CallbackServerContext& context, Method method,
    const google::protobuf::MessageLite& request,
    absl::FunctionRef<CallOutcome(const Credential& caller, DeferredWork*)> handle);

// As AnswerUnary, for a call that takes long: `handle` runs on the background worker. Refuses the
// call with UNAVAILABLE if the worker's queue is full.
grpc::ServerUnaryReactor* AnswerUnaryInBackground(
    const ServiceParts& parts, const grpc::CallbackServerContext& context, Method method,
    const google::protobuf::MessageLite& request,
    std::function<absl::Status(const Credential& caller)> handle);

}  // namespace spikeserve

#endif  // SERVER_RPC_UNARY_CALL_H_
