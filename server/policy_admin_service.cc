#include "server/policy_admin_service.h"

#include "server/unary_call.h"

namespace spikeserve {

grpc::ServerUnaryReactor* PolicyAdminService::ListSessions(grpc::CallbackServerContext*,
                                                           const v1::ListSessionsRequest* request,
                                                           v1::ListSessionsResponse* response) {
  return AnswerUnary(parts_, Method::kListSessions,
                     [&](DeferredWork*) { return admin_->ListSessions(*request, response); });
}

}  // namespace spikeserve
