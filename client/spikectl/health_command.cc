#include <string>

#include "absl/strings/str_cat.h"
#include "client/spikectl/admin_call.h"
#include "client/spikectl/commands.h"
#include "core/base/status_macros.h"
#include "grpc/health/v1/health.grpc.pb.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

using grpc::health::v1::HealthCheckResponse;

absl::StatusOr<ServerAnswer> CheckHealth(const ServerFlags& flags) {
  ASSIGN_OR_RETURN(const auto client, Connect(flags));
  HealthCheckResponse response;
  RETURN_IF_ERROR(client->CallOther(
      kAdminTimeout, /*repeatable=*/true,
      [&](const std::shared_ptr<grpc::Channel>& channel, grpc::ClientContext* context) {
        return grpc::health::v1::Health::NewStub(channel)->Check(context, {}, &response);
      }));
  const std::string& state = HealthCheckResponse::ServingStatus_Name(response.status());
  if (response.status() != HealthCheckResponse::SERVING) {
    return absl::UnavailableError(absl::StrCat("health: expected SERVING, received ", state));
  }
  return ServerAnswer{state, {{"health", state}}};
}

}  // namespace

void AddHealthCommand(Command program, const ServerFlags& server) {
  program.AddCommand("health", "Fails unless every server answers and is ready for sessions")
      .SetAction([&server] { return OnEveryServer(server, CheckHealth); });
}

}  // namespace spikeserve
