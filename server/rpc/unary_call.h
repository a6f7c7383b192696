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

// The result of a call.
struct CallOutcome {
  // NOLINTNEXTLINE(google-explicit-constructor): a handler returns a plain status as its outcome.
  CallOutcome(absl::Status ended) : status(ended), refusal(std::move(ended)) {}
  CallOutcome(absl::Status ended, absl::Status refused)
      : status(std::move(ended)), refusal(std::move(refused)) {}

  absl::Status status;   // sent to the caller
  absl::Status refusal;  // decides how long the answer is delayed; differs from `status` for a
                         // batch that succeeds but contains refused items
};

// Returns the caller of `method`, or the error of Admit().
absl::StatusOr<const Credential*> AdmitCaller(const ServiceParts& parts,
                                              const grpc::CallbackServerContext& context,
                                              Method method);

// Answers a call with the outcome of `handle`, which fills in the response, and records the call in
// the metrics. Refuses the call if the server drains, the caller is not admitted or the request is
// too long. The work that `handle` defers runs after the answer has been sent. `parts` must outlive
// the call.
grpc::ServerUnaryReactor* AnswerUnary(
    const ServiceParts& parts, const grpc::CallbackServerContext& context, Method method,
    const google::protobuf::MessageLite& request,
    absl::FunctionRef<CallOutcome(const Credential& caller, DeferredWork*)> handle);

// As AnswerUnary, but runs `handle` on the background worker. For calls that take long. Refuses the
// call with UNAVAILABLE if the worker's queue is full.
grpc::ServerUnaryReactor* AnswerUnaryInBackground(
    const ServiceParts& parts, const grpc::CallbackServerContext& context, Method method,
    const google::protobuf::MessageLite& request,
    std::function<absl::Status(const Credential& caller)> handle);

}  // namespace spikeserve

#endif  // SERVER_RPC_UNARY_CALL_H_
