#include <iostream>
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

absl::Status CheckHealth(const ServerFlags& flags) {
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
  std::cout << (flags.json ? nlohmann::ordered_json{{"health", state}}.dump(2) : state) << "\n";
  return absl::OkStatus();
}

}  // namespace

void AddHealthCommand(Command program, const ServerFlags& server) {
  program.AddCommand("health", "Fails unless the server answers and is ready for sessions")
      .SetAction([&server] { return CheckHealth(server); });
}

}  // namespace spikeserve
