#include <iostream>
#include <string>

#include "absl/strings/str_cat.h"
#include "client/spikectl/admin_call.h"
#include "client/spikectl/commands.h"
#include "grpc/health/v1/health.grpc.pb.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

using grpc::health::v1::HealthCheckResponse;

absl::Status CheckHealth(const ServerFlags& flags) {
  const auto client = Connect(flags);
  if (!client.ok()) return client.status();
  HealthCheckResponse response;
  const absl::Status status = (*client)->CallOther(
      kAdminTimeout, /*repeatable=*/true,
      [&](const std::shared_ptr<grpc::Channel>& channel, grpc::ClientContext* context) {
        return grpc::health::v1::Health::NewStub(channel)->Check(context, {}, &response);
      });
  if (!status.ok()) return status;
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
