// What every action of `spikectl admin` does: one call of PolicyAdmin, made of the flags, and one
// line or object printed.
#ifndef CLIENT_SPIKECTL_ADMIN_CALL_H_
#define CLIENT_SPIKECTL_ADMIN_CALL_H_

#include <grpcpp/client_context.h>

#include <cstdint>
#include <iostream>
#include <string>

#include "absl/flags/declare.h"
#include "absl/flags/flag.h"
#include "absl/status/statusor.h"
#include "absl/time/clock.h"
#include "absl/time/time.h"
#include "client/spikectl/common_flags.h"
#include "nlohmann/json.hpp"
#include "spikeserve/status.h"
#include "spikeserve/v1/policy_admin.grpc.pb.h"

ABSL_DECLARE_FLAG(std::string, policy);
ABSL_DECLARE_FLAG(int64_t, version);

namespace spikeserve {

using AdminStub = v1::PolicyAdmin::Stub;

// Loading reads files and decides once, so it takes longer than a decision.
inline constexpr absl::Duration kAdminTimeout = absl::Seconds(60);

template <typename Request, typename Response>
absl::StatusOr<Response> CallAdmin(grpc::Status (AdminStub::*method)(grpc::ClientContext*,
                                                                     const Request&, Response*),
                                   const Request& request) {
  const auto client = ConnectToServer();
  if (!client.ok()) return client.status();
  const auto stub = v1::PolicyAdmin::NewStub((*client)->channel());
  grpc::ClientContext context;
  context.set_deadline(absl::ToChronoTime(absl::Now() + kAdminTimeout));
  Response response;
  const grpc::Status status = ((*stub).*method)(&context, request, &response);
  if (!status.ok()) return StatusFromGrpc(status);
  return response;
}

// A request of --policy and --version.
template <typename Request>
Request VersionRequest() {
  Request request;
  request.set_policy(absl::GetFlag(FLAGS_policy));
  request.set_version(absl::GetFlag(FLAGS_version));
  return request;
}

// The text, or the object where --json asks for it.
inline void Print(const std::string& text, const nlohmann::ordered_json& json) {
  std::cout << (absl::GetFlag(FLAGS_json) ? json.dump(2) : text) << "\n";
}

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_ADMIN_CALL_H_
