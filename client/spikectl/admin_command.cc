#include <cstdint>
#include <string>
#include <vector>

#include "absl/flags/flag.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_split.h"
#include "client/spikectl/admin_call.h"
#include "client/spikectl/commands.h"
#include "client/spikectl/head_actions.h"

ABSL_FLAG(std::string, label, "", "Name of a version, such as stable (admin label, unlabel)");
ABSL_FLAG(std::vector<std::string>, shares, {},
          "VERSION:PERCENT of the new sessions, separated by commas; none: all to the default "
          "version (admin traffic)");
ABSL_FLAG(int64_t, shadow, 0, "Version that shadows the others; 0: none (admin traffic)");
ABSL_FLAG(bool, cancel, false, "Take new sessions again (admin drain)");

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

absl::Status RequirePolicy() {
  if (!absl::GetFlag(FLAGS_policy).empty()) return absl::OkStatus();
  return absl::InvalidArgumentError("--policy: expected a name, received none");
}

std::string Named() {
  return absl::StrCat(absl::GetFlag(FLAGS_policy), "/", absl::GetFlag(FLAGS_version));
}

ordered_json NamedJson() {
  return {{"policy", absl::GetFlag(FLAGS_policy)}, {"version", absl::GetFlag(FLAGS_version)}};
}

absl::Status Load() {
  const auto response = CallAdmin(&AdminStub::LoadPolicy, VersionRequest<v1::LoadPolicyRequest>());
  if (!response.ok()) return response.status();
  ordered_json json = NamedJson();
  json["is_default"] = response->policy().is_default();
  Print(absl::StrCat("loaded ", Named(), response->policy().is_default() ? ", the default" : ""),
        json);
  return absl::OkStatus();
}

absl::Status Unload() {
  const auto response =
      CallAdmin(&AdminStub::UnloadPolicy, VersionRequest<v1::UnloadPolicyRequest>());
  if (!response.ok()) return response.status();
  Print(absl::StrCat("unloaded ", Named()), NamedJson());
  return absl::OkStatus();
}

absl::Status Default() {
  const auto response =
      CallAdmin(&AdminStub::SetDefaultVersion, VersionRequest<v1::SetDefaultVersionRequest>());
  if (!response.ok()) return response.status();
  const std::string policy = absl::GetFlag(FLAGS_policy);
  Print(absl::StrCat("the default of ", policy, " is version ", response->version()),
        {{"policy", policy}, {"version", response->version()}});
  return absl::OkStatus();
}

absl::Status Label() {
  auto request = VersionRequest<v1::SetLabelRequest>();
  request.set_label(absl::GetFlag(FLAGS_label));
  const auto response = CallAdmin(&AdminStub::SetLabel, request);
  if (!response.ok()) return response.status();
  ordered_json json = NamedJson();
  json["label"] = request.label();
  Print(absl::StrCat(request.label(), " is ", Named()), json);
  return absl::OkStatus();
}

absl::Status Unlabel() {
  v1::RemoveLabelRequest request;
  request.set_policy(absl::GetFlag(FLAGS_policy));
  request.set_label(absl::GetFlag(FLAGS_label));
  const auto response = CallAdmin(&AdminStub::RemoveLabel, request);
  if (!response.ok()) return response.status();
  Print(absl::StrCat("removed ", request.label(), " of ", request.policy()),
        {{"policy", request.policy()}, {"label", request.label()}});
  return absl::OkStatus();
}

// VERSION:PERCENT.
absl::StatusOr<v1::TrafficShare> ParseShare(absl::string_view text) {
  const std::vector<absl::string_view> parts = absl::StrSplit(text, ':');
  int64_t version = 0;
  int32_t percent = 0;
  if (parts.size() != 2 || !absl::SimpleAtoi(parts[0], &version) ||
      !absl::SimpleAtoi(parts[1], &percent)) {
    return absl::InvalidArgumentError(
        absl::StrCat("--shares: expected VERSION:PERCENT, received \"", text, "\""));
  }
  v1::TrafficShare share;
  share.set_version(version);
  share.set_percent(percent);
  return share;
}

absl::Status Traffic() {
  v1::SetTrafficRequest request;
  request.set_policy(absl::GetFlag(FLAGS_policy));
  request.set_shadow_version(absl::GetFlag(FLAGS_shadow));
  ordered_json shares = ordered_json::array();
  for (const std::string& text : absl::GetFlag(FLAGS_shares)) {
    const auto share = ParseShare(text);
    if (!share.ok()) return share.status();
    *request.add_shares() = *share;
    shares.push_back({{"version", share->version()}, {"percent", share->percent()}});
  }
  const auto response = CallAdmin(&AdminStub::SetTraffic, request);
  if (!response.ok()) return response.status();
  const std::string to = absl::StrJoin(absl::GetFlag(FLAGS_shares), ", ");
  Print(
      absl::StrCat(
          "traffic of ", request.policy(), ": ", to.empty() ? "the default" : to,
          request.shadow_version() == 0 ? "" : absl::StrCat("; shadow ", request.shadow_version())),
      {{"policy", request.policy()},
       {"shares", shares},
       {"shadow_version", request.shadow_version()}});
  return absl::OkStatus();
}

template <typename List>
ordered_json VersionsToJson(const List& versions) {
  ordered_json json = ordered_json::array();
  for (const v1::PolicyVersion& version : versions) {
    json.push_back({{"policy", version.policy()}, {"version", version.version()}});
  }
  return json;
}

absl::Status Reload() {
  const auto response = CallAdmin(&AdminStub::ReloadPolicies, v1::ReloadPoliciesRequest());
  if (!response.ok()) return response.status();
  std::string text =
      absl::StrCat("loaded ", response->loaded_size(), ", unloaded ", response->unloaded_size());
  for (const std::string& refused : response->refused()) {
    absl::StrAppend(&text, "\nrefused: ", refused);
  }
  for (const std::string& setting : response->waiting()) {
    absl::StrAppend(&text, "\nwaiting: ", setting);
  }
  Print(text, {{"loaded", VersionsToJson(response->loaded())},
               {"unloaded", VersionsToJson(response->unloaded())},
               {"refused", response->refused()},
               {"waiting", response->waiting()}});
  return absl::OkStatus();
}

ordered_json ToJson(const v1::SessionInfo& session) {
  return {{"session_id", session.session_id()},
          {"policy", session.policy()},
          {"version", session.version()},
          {"tenant", session.tenant()},
          {"episode", session.episode()},
          {"step", session.step()},
          {"episode_return", session.episode_return()},
          {"decisions", session.decisions()},
          {"spikes", session.spikes()},
          {"energy_joules", session.energy_joules()},
          {"idle_seconds", session.idle_seconds()},
          {"learning", session.learning()}};
}

absl::Status Sessions() {
  auto request = VersionRequest<v1::ListSessionsRequest>();
  std::string text = absl::StrFormat("%-32s %-20s %7s %-12s %8s %8s %10s %8s", "SESSION", "POLICY",
                                     "VERSION", "TENANT", "EPISODE", "STEP", "DECISIONS", "IDLE_S");
  ordered_json sessions = ordered_json::array();
  do {
    const auto page = CallAdmin(&AdminStub::ListSessions, request);
    if (!page.ok()) return page.status();
    for (const v1::SessionInfo& session : page->sessions()) {
      sessions.push_back(ToJson(session));
      absl::StrAppendFormat(&text, "\n%-32s %-20s %7d %-12s %8d %8d %10d %8.1f",
                            session.session_id(), session.policy(), session.version(),
                            session.tenant(), session.episode(), session.step(),
                            session.decisions(), session.idle_seconds());
    }
    request.set_page_token(page->next_page_token());
  } while (!request.page_token().empty());
  Print(text, {{"sessions", sessions}});
  return absl::OkStatus();
}

absl::Status Drain() {
  v1::DrainRequest request;
  request.set_cancel(absl::GetFlag(FLAGS_cancel));
  const auto response = CallAdmin(&AdminStub::Drain, request);
  if (!response.ok()) return response.status();
  Print(absl::StrCat(request.cancel() ? "serving" : "draining",
                     ", open sessions: ", response->open_sessions()),
        {{"draining", !request.cancel()}, {"open_sessions", response->open_sessions()}});
  return absl::OkStatus();
}

struct Action {
  const char* name;
  bool needs_policy;
  const char* flags;  // beside those that every command has
  absl::Status (*run)();
};

constexpr Action kActions[] = {
    {"load", true, "policy version", Load},
    {"unload", true, "policy version", Unload},
    {"default", true, "policy version", Default},
    {"label", true, "policy version label", Label},
    {"unlabel", true, "policy label", Unlabel},
    {"traffic", true, "policy shares shadow", Traffic},
    {"reload", false, "", Reload},
    {"sessions", false, "policy version", Sessions},
    {"drain", false, "cancel", Drain},
    {"head", true, "policy version weights", ShowHead},
    {"promote", true, "policy version", PromoteHead},
    {"rollback", true, "policy version", RollbackHead},
    {"pause", false, "policy", PauseLearning},
    {"resume", false, "policy", ResumeLearning},
};

}  // namespace

absl::Status AdminCommand(absl::string_view name) {
  for (const Action& action : kActions) {
    if (name != action.name) continue;
    if (absl::Status status = action.needs_policy ? RequirePolicy() : absl::OkStatus();
        !status.ok()) {
      return status;
    }
    if (auto status = CheckFlags(absl::StrCat("admin ", name), action.flags); !status.ok()) {
      return status;
    }
    return action.run();
  }
  const std::string names = absl::StrJoin(
      kActions, ", ", [](std::string* out, const Action& action) { out->append(action.name); });
  return absl::InvalidArgumentError(
      absl::StrCat("admin: expected one of ", names, ", received \"", name, "\""));
}

}  // namespace spikeserve
