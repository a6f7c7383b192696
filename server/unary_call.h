// One unary call on gRPC's callback API, on the books of the server from its start to its end.
#ifndef SERVER_UNARY_CALL_H_
#define SERVER_UNARY_CALL_H_

#include <grpcpp/support/server_callback.h>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "server/act_stream.h"

namespace spikeserve {

// Answers a call with the status of `handle`, which fills in the response, or refuses it where the
// server drains; records it. What `handle` defers is done once the answer has been sent.
grpc::ServerUnaryReactor* AnswerUnary(const ServiceParts& parts, Method method,
                                      absl::FunctionRef<absl::Status(DeferredWork*)> handle);

}  // namespace spikeserve

#endif  // SERVER_UNARY_CALL_H_
