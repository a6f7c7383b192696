#include <algorithm>
#include <iostream>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "absl/strings/strip.h"
#include "client/spikectl/admin_call.h"
#include "client/spikectl/commands.h"
#include "core/base/rounded.h"
#include "core/base/status_macros.h"
#include "proto/json.h"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

ordered_json ToJson(const v1::ActionSpace& space) {
  if (space.has_discrete()) return {{"type", "Discrete"}, {"n", space.discrete().n()}};
  return {{"type", "Box"}, {"low", space.box().low()}, {"high", space.box().high()}};
}

using FeatureList = google::protobuf::RepeatedPtrField<v1::Feature>;

// Leaves out what a feature does not have.
ordered_json ToJson(const FeatureList& features) {
  ordered_json list = MessagesToList(features, Numbers::kExact);
  for (ordered_json& feature : list) {
    for (const char* field : {"unit", "frame"}) {
      if (feature[field] == "") feature.erase(field);
    }
  }
  return list;
}

ordered_json ToJson(const v1::PolicyInfo& policy) {
  ordered_json json = MessageToFields(policy, Numbers::kExact);
  json["action_space"] = ToJson(policy.action_space());
  json["observation_features"] = ToJson(policy.observation_features());
  json["action_features"] = ToJson(policy.action_features());
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

// Returns whether operators or new sessions use the version: it is the default, has a share of the
// traffic, a label, a roll-out, or shadows another one.
bool IsInUse(const v1::PolicyInfo& policy, const std::string& rollout) {
  return policy.is_default() || policy.traffic_percent() > 0 || policy.version_labels_size() > 0 ||
         policy.is_shadow() || !rollout.empty();
}

constexpr size_t kTableWidth = 100;
constexpr size_t kEnvironmentColumn = 1;
constexpr size_t kNarrowestEnvironment = 12;

// Returns lines whose columns are as wide as their widest cell. Cuts environments, which may have
// names of any length, so that the lines fit kTableWidth.
std::string ToTable(std::vector<std::vector<std::string>> rows) {
  std::vector<size_t> widths(rows.front().size(), 0);
  for (const auto& row : rows) {
    for (size_t i = 0; i < row.size(); ++i) widths[i] = std::max(widths[i], row[i].size());
  }
  size_t others = 2 * (widths.size() - 1);  // the spaces between columns
  for (const size_t width : widths) others += width;
  size_t& environment = widths[kEnvironmentColumn];
  others -= environment;
  environment = std::min(
      environment, std::max(kNarrowestEnvironment, kTableWidth - std::min(kTableWidth, others)));
  std::string table;
  for (auto& row : rows) {
    if (row[kEnvironmentColumn].size() > environment) {
      row[kEnvironmentColumn] =
          absl::StrCat(row[kEnvironmentColumn].substr(0, environment - 3), "...");
    }
    std::string line;
    for (size_t i = 0; i < row.size(); ++i) {
      absl::StrAppendFormat(&line, "%-*s  ", static_cast<int>(widths[i]), row[i]);
    }
    absl::StrAppend(&table, absl::StripTrailingAsciiWhitespace(line), "\n");
  }
  return table;
}

void PrintText(const v1::ListPoliciesResponse& response, const v1::ListRolloutsResponse& rollouts,
               bool all) {
  std::vector<std::vector<std::string>> rows = {
      {"POLICY", "ENVIRONMENT", "MODE", "INPUTS", "ACTION", "RETURN", "LOST", "TRAFFIC"}};
  for (const v1::PolicyInfo& policy : response.policies()) {
    const std::string rollout = RolloutOf(policy, rollouts);
    if (!all && !IsInUse(policy, rollout)) continue;
    rows.push_back(
        {absl::StrCat(policy.name(), "/", policy.version()), policy.environment(), policy.mode(),
         absl::StrCat(policy.observation_size()), ToText(policy.action_space()),
         policy.has_training_return() ? absl::StrFormat("%.1f", policy.training_return()) : "-",
         policy.has_rounding_loss()
             ? absl::StrFormat("%.1f%%", Rounded(100 * policy.rounding_loss(), 1))
             : "-",
         TrafficText(policy, rollout)});
  }
  const size_t others = static_cast<size_t>(response.policies_size()) + 1 - rows.size();
  std::cout << ToTable(std::move(rows));
  if (others > 0) std::cout << others << " more that new sessions do not get: --all lists them\n";
}

void PrintFeatures(const char* kind, const FeatureList& features) {
  for (int i = 0; i < features.size(); ++i) {
    const v1::Feature& feature = features[i];
    std::string range;
    if (feature.has_low()) absl::StrAppend(&range, " from ", feature.low());
    if (feature.has_high()) absl::StrAppend(&range, " to ", feature.high());
    if (!feature.frame().empty()) absl::StrAppend(&range, " in ", feature.frame());
    std::cout << absl::StrFormat("  %s[%d] %s %s%s\n", kind, i, feature.name(), feature.unit(),
                                 range);
  }
}

void PrintFeatures(const v1::ListPoliciesResponse& response) {
  for (const v1::PolicyInfo& policy : response.policies()) {
    std::cout << policy.name() << "/" << policy.version();
    if (policy.has_rate_hz()) {
      std::cout << " at " << policy.rate_hz() << " Hz within " << 100.0 * policy.rate_tolerance()
                << " %";
    }
    std::cout << (policy.observation_features().empty() ? ": no names\n" : "\n");
    PrintFeatures("observation", policy.observation_features());
    PrintFeatures("action", policy.action_features());
  }
}

absl::Status ListPolicies(const ServerFlags& flags, bool all, bool features) {
  ASSIGN_OR_RETURN(const auto client, Connect(flags));
  ASSIGN_OR_RETURN(const auto response, client->ListPolicies());
  const v1::ListRolloutsResponse rollouts = ListRollouts(*client);
  if (features && !flags.json) {
    PrintFeatures(response);
    return absl::OkStatus();
  }
  if (!flags.json) {
    PrintText(response, rollouts, all);
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
  const Command command = program.AddCommand(
      "policies", "Lists the versions that new sessions get, and those with labels");
  const auto all = std::make_shared<bool>(false);
  const auto features = std::make_shared<bool>(false);
  command.Flags("Listing")
      .AddSwitch("all", all.get(), "List every version that the server has; --json always does")
      .AddSwitch("features", features.get(),
                 "List the names and units of every version's elements");
  command.SetAction([all, features, &server] { return ListPolicies(server, *all, *features); });
}

}  // namespace spikeserve
