#include <cstdio>
#include <iostream>
#include <string>
#include <vector>

#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "absl/strings/strip.h"
#include "client/spikectl/admin_call.h"
#include "client/spikectl/commands.h"
#include "core/base/status_macros.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

ordered_json ToJson(const v1::ActionSpace& space) {
  if (space.has_discrete()) return {{"type", "Discrete"}, {"n", space.discrete().n()}};
  return {{"type", "Box"}, {"low", space.box().low()}, {"high", space.box().high()}};
}

ordered_json ToJson(const v1::PolicyInfo& policy) {
  ordered_json json = {{"name", policy.name()},
                       {"version", policy.version()},
                       {"is_default", policy.is_default()},
                       {"environment", policy.environment()},
                       {"mode", policy.mode()},
                       {"observation_size", policy.observation_size()},
                       {"action_space", ToJson(policy.action_space())},
                       {"context_length", policy.context_length()},
                       {"target_return", policy.target_return()}};
  if (policy.has_training_return()) json["training_return"] = policy.training_return();
  if (policy.has_traffic_percent()) json["traffic_percent"] = policy.traffic_percent();
  if (policy.version_labels_size() > 0) json["version_labels"] = policy.version_labels();
  if (policy.is_shadow()) json["is_shadow"] = true;
  return json;
}

std::string ToText(const v1::ActionSpace& space) {
  if (space.has_discrete()) return absl::StrCat("Discrete(", space.discrete().n(), ")");
  return absl::StrCat("Box(", space.box().low_size(), ")");
}

// Returns no roll-outs for callers that may not list them, such as agents.
v1::ListRolloutsResponse ListRollouts(Client& client) {
  v1::ListRolloutsResponse response;
  const absl::Status status = client.CallOther(
      kAdminTimeout, /*repeatable=*/true,
      [&](const std::shared_ptr<grpc::Channel>& channel, grpc::ClientContext* context) {
        return v1::PolicyAdmin::NewStub(channel)->ListRollouts(context, {}, &response);
      });
  if (!status.ok()) response.Clear();
  return response;
}

// Returns the state of the last roll-out of this version, such as "running"; empty if it had none.
std::string RolloutOf(const v1::PolicyInfo& policy, const v1::ListRolloutsResponse& rollouts) {
  for (const v1::Rollout& rollout : rollouts.rollouts()) {
    if (rollout.policy() == policy.name() && rollout.version() == policy.version()) {
      return absl::AsciiStrToLower(
          absl::StripPrefix(v1::Rollout::State_Name(rollout.state()), "STATE_"));
    }
  }
  return "";
}

// Returns the share of the new sessions, the labels and the shadow of a version, for example
// "95% stable shadow".
std::string TrafficText(const v1::PolicyInfo& policy, const std::string& rollout) {
  std::vector<std::string> parts;
  if (policy.has_traffic_percent()) {
    parts.push_back(absl::StrCat(policy.traffic_percent(), "%"));
  } else if (policy.is_default()) {
    parts.emplace_back("100%");
  }
  parts.insert(parts.end(), policy.version_labels().begin(), policy.version_labels().end());
  if (policy.is_shadow()) parts.emplace_back("(shadow)");
  if (!rollout.empty()) parts.push_back(absl::StrCat("(roll-out ", rollout, ")"));
  return absl::StrJoin(parts, " ");
}

void PrintText(const v1::ListPoliciesResponse& response, const v1::ListRolloutsResponse& rollouts) {
  absl::PrintF("%-20s %7s %7s  %-15s %-8s %11s  %-11s %7s %13s %15s  %s\n", "POLICY", "VERSION",
               "DEFAULT", "ENVIRONMENT", "MODE", "OBSERVATION", "ACTION", "CONTEXT",
               "TARGET_RETURN", "TRAINING_RETURN", "TRAFFIC");
  for (const v1::PolicyInfo& policy : response.policies()) {
    const std::string training_return =
        policy.has_training_return() ? absl::StrFormat("%.1f", policy.training_return()) : "-";
    absl::PrintF("%-20s %7d %7s  %-15s %-8s %11d  %-11s %7d %13.1f %15s  %s\n", policy.name(),
                 policy.version(), policy.is_default() ? "yes" : "", policy.environment(),
                 policy.mode(), policy.observation_size(), ToText(policy.action_space()),
                 policy.context_length(), policy.target_return(), training_return,
                 TrafficText(policy, RolloutOf(policy, rollouts)));
  }
}

absl::Status ListPolicies(const ServerFlags& flags) {
  ASSIGN_OR_RETURN(const auto client, Connect(flags));
  ASSIGN_OR_RETURN(const auto response, client->ListPolicies());
  const v1::ListRolloutsResponse rollouts = ListRollouts(*client);
  if (!flags.json) {
    PrintText(response, rollouts);
    return absl::OkStatus();
  }
  ordered_json json = {{"policies", ordered_json::array()}};
  for (const v1::PolicyInfo& policy : response.policies()) {
    json["policies"].push_back(ToJson(policy));
    const std::string rollout = RolloutOf(policy, rollouts);
    if (!rollout.empty()) json["policies"].back()["rollout_state"] = rollout;
  }
  std::cout << json.dump(2) << "\n";
  return absl::OkStatus();
}

}  // namespace

void AddPoliciesCommand(Command program, const ServerFlags& server) {
  program.AddCommand("policies", "Lists the policy versions that the server serves")
      .SetAction([&server] { return ListPolicies(server); });
}

}  // namespace spikeserve
