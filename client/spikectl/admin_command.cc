#include <cstdint>
#include <iostream>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_split.h"
#include "client/spikectl/admin_actions.h"
#include "client/spikectl/admin_call.h"
#include "client/spikectl/commands.h"
#include "client/spikectl/traffic_report.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "proto/json.h"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

std::string Named(const AdminFlags& flags) {
  return absl::StrCat(flags.policy, "/", flags.version);
}

ordered_json NamedJson(const AdminFlags& flags) {
  return {{"policy", flags.policy}, {"version", flags.version}};
}

absl::StatusOr<ServerAnswer> Load(const AdminFlags& flags) {
  auto request = VersionRequest<v1::LoadPolicyRequest>(flags);
  request.set_make_default(flags.make_default);
  ASSIGN_OR_RETURN(const auto response, CallAdmin(flags, &AdminStub::LoadPolicy, request));
  ordered_json json = NamedJson(flags);
  json["is_default"] = response.policy().is_default();
  ServerAnswer answer = TrafficAnswer(
      absl::StrCat("loaded ", Named(flags), response.policy().is_default() ? ", the default" : ""),
      std::move(json), response.traffic());
  answer.shared = false;  // each server loads its own file
  return answer;
}

absl::StatusOr<ServerAnswer> Unload(const AdminFlags& flags) {
  ASSIGN_OR_RETURN(const auto response, CallAdmin(flags, &AdminStub::UnloadPolicy,
                                                  VersionRequest<v1::UnloadPolicyRequest>(flags)));
  return TrafficAnswer(absl::StrCat("unloaded ", Named(flags)), NamedJson(flags),
                       response.traffic());
}

absl::StatusOr<ServerAnswer> Default(const AdminFlags& flags) {
  ASSIGN_OR_RETURN(const auto response,
                   CallAdmin(flags, &AdminStub::SetDefaultVersion,
                             VersionRequest<v1::SetDefaultVersionRequest>(flags)));
  const std::string& policy = flags.policy;
  return TrafficAnswer(absl::StrCat("the default of ", policy, " is version ", response.version()),
                       {{"policy", policy}, {"version", response.version()}}, response.traffic());
}

absl::StatusOr<ServerAnswer> Label(const AdminFlags& flags) {
  auto request = VersionRequest<v1::SetLabelRequest>(flags);
  request.set_label(flags.label);
  ASSIGN_OR_RETURN(const auto response, CallAdmin(flags, &AdminStub::SetLabel, request));
  ordered_json json = NamedJson(flags);
  json["label"] = request.label();
  return TrafficAnswer(absl::StrCat(request.label(), " is ", Named(flags)), std::move(json),
                       response.traffic());
}

absl::StatusOr<ServerAnswer> Unlabel(const AdminFlags& flags) {
  v1::RemoveLabelRequest request;
  request.set_policy(flags.policy);
  request.set_label(flags.label);
  ASSIGN_OR_RETURN(const auto response, CallAdmin(flags, &AdminStub::RemoveLabel, request));
  return TrafficAnswer(absl::StrCat("removed ", request.label(), " of ", request.policy()),
                       {{"policy", request.policy()}, {"label", request.label()}},
                       response.traffic());
}

// VERSION:PERCENT.
absl::StatusOr<v1::TrafficShare> ParseShare(absl::string_view text) {
  const std::vector<absl::string_view> parts = absl::StrSplit(text, ':');
  int64_t version = 0;
  int32_t percent = 0;
  if (parts.size() != 2 || !absl::SimpleAtoi(parts[0], &version) ||
      !absl::SimpleAtoi(parts[1], &percent)) {
    return InvalidArgument("--shares", "VERSION:PERCENT", absl::StrCat("\"", text, "\""));
  }
  v1::TrafficShare share;
  share.set_version(version);
  share.set_percent(percent);
  return share;
}

// Parses --shares; "none" gives all sessions to the default version.
absl::StatusOr<std::vector<v1::TrafficShare>> ParseShares(const std::vector<std::string>& texts) {
  std::vector<v1::TrafficShare> shares;
  if (texts.size() == 1 && texts[0] == "none") return shares;
  for (const std::string& text : texts) {
    ASSIGN_OR_RETURN(auto share, ParseShare(text));
    shares.push_back(std::move(share));
  }
  return shares;
}

// Describes the change of the shares or the shadow that `response` reports.
template <typename Response>
absl::StatusOr<ServerAnswer> DescribeTraffic(const AdminFlags& flags,
                                             const absl::StatusOr<Response>& response) {
  if (!response.ok()) return response.status();
  const v1::Traffic& after = response->traffic().after();
  return TrafficAnswer(absl::StrCat("traffic of ", flags.policy),
                       {{"policy", flags.policy},
                        {"shares", MessagesToList(after.shares(), Numbers::kExact)},
                        {"shadow_version", after.shadow_version()}},
                       response->traffic());
}

// Changes only what a flag names.
absl::StatusOr<ServerAnswer> Traffic(const AdminFlags& flags) {
  if (flags.shares.empty() && !flags.shadow.has_value()) {
    return InvalidArgument("--shares", "shares, none, or --shadow instead",
                           "neither; --shares=none gives all sessions to the default version, "
                           "--shadow=0 removes the shadow");
  }
  ASSIGN_OR_RETURN(const auto shares, ParseShares(flags.shares));
  const auto fill = [&](auto request) {
    request.set_policy(flags.policy);
    if constexpr (requires { request.add_shares(); }) {
      request.mutable_shares()->Add(shares.begin(), shares.end());
    }
    if constexpr (requires { request.set_shadow_version(0); }) {
      request.set_shadow_version(*flags.shadow);
    }
    return request;
  };
  if (flags.shares.empty()) {
    return DescribeTraffic(flags,
                           CallAdmin(flags, &AdminStub::SetShadow, fill(v1::SetShadowRequest())));
  }
  if (!flags.shadow.has_value()) {
    return DescribeTraffic(
        flags, CallAdmin(flags, &AdminStub::SetTrafficShares, fill(v1::SetTrafficSharesRequest())));
  }
  return DescribeTraffic(flags,
                         CallAdmin(flags, &AdminStub::SetTraffic, fill(v1::SetTrafficRequest())));
}

absl::StatusOr<ServerAnswer> Reload(const AdminFlags& flags) {
  ASSIGN_OR_RETURN(const auto response,
                   CallAdmin(flags, &AdminStub::ReloadPolicies, v1::ReloadPoliciesRequest()));
  std::string text =
      absl::StrCat("loaded ", response.loaded_size(), ", unloaded ", response.unloaded_size());
  for (const std::string& refused : response.refused()) {
    absl::StrAppend(&text, "\nrefused: ", refused);
  }
  for (const std::string& setting : response.waiting()) {
    absl::StrAppend(&text, "\nwaiting: ", setting);
  }
  return ServerAnswer{text,
                      {{"loaded", MessagesToList(response.loaded(), Numbers::kExact)},
                       {"unloaded", MessagesToList(response.unloaded(), Numbers::kExact)},
                       {"refused", response.refused()},
                       {"waiting", response.waiting()}}};
}

constexpr int kPageSize = 1000;  // sessions
constexpr int kMostPages = 1000;

// Appends the line of a session, and what it has learned from operators.
void AppendSession(const v1::SessionInfo& session, bool by_need, std::string* text) {
  absl::StrAppendFormat(text, "\n%-32s %-17s", session.session_id(),
                        absl::StrCat(session.policy(), "/", session.version()));
  if (by_need) {
    const v1::NeedsHelp& need = session.needs_help();
    absl::StrAppendFormat(text, " %5.2f %7.2f %7.2f %7.2f %8.2f", need.score(),
                          need.unusual_observations(), need.entropy(), need.low_return(),
                          need.fallbacks());
  } else {
    absl::StrAppendFormat(text, " %-9s %7d %6d %9d %7.1f %-6s", session.tenant(), session.episode(),
                          session.step(), session.decisions(), session.idle_seconds(),
                          v1::Durability_Name(session.durability()));
  }
  if (!session.has_corrections()) return;
  const v1::Corrections& corrections = session.corrections();
  absl::StrAppendFormat(text, "\n  %d steps of operators; apart from them: %.3f, %.3f at the start",
                        corrections.steps(), corrections.disagreement(),
                        corrections.start_disagreement());
}

absl::StatusOr<ServerAnswer> Sessions(const AdminFlags& flags) {
  auto request = VersionRequest<v1::ListSessionsRequest>(flags);
  request.set_by_need(flags.by_need);
  std::string text =
      flags.by_need ? absl::StrFormat("%-32s %-17s %5s %7s %7s %7s %8s", "SESSION", "POLICY",
                                      "NEED", "UNUSUAL", "ENTROPY", "RETURN", "FALLBACK")
                    : absl::StrFormat("%-32s %-17s %-9s %7s %6s %9s %7s %-6s", "SESSION", "POLICY",
                                      "TENANT", "EPISODE", "STEP", "DECISIONS", "IDLE_S", "STORED");
  ordered_json sessions = ordered_json::array();
  std::string replica;
  int64_t open = 0;  // of those in the store
  std::optional<int64_t> stored;
  int pages = 0;
  request.set_page_size(kPageSize);
  do {
    ASSIGN_OR_RETURN(const auto page, CallAdmin(flags, &AdminStub::ListSessions, request));
    for (const v1::SessionInfo& session : page.sessions()) {
      sessions.push_back(MessageToFields(session, Numbers::kExact));
      AppendSession(session, flags.by_need, &text);
    }
    replica = page.replica();
    open = page.open_stored_sessions();
    if (page.has_stored_sessions()) stored = page.stored_sessions();
    const bool goes_on = !page.next_page_token().empty();
    if (goes_on && (page.sessions().empty() || ++pages == kMostPages)) {
      return absl::DataLossError(absl::StrCat(
          "sessions: expected at most ", kMostPages, " pages, each with sessions, received ",
          page.sessions_size(), " sessions and another page after ", pages));
    }
    request.set_page_token(page.next_page_token());
  } while (!request.page_token().empty());
  ordered_json json = {{"sessions", sessions}, {"replica", replica}};
  if (stored.has_value()) json["stored_sessions"] = *stored;
  if (stored.has_value() && *stored > open) {
    absl::StrAppend(&text, "\n", *stored - open,
                    " more in the session store; each is open again with its next request");
  } else if (!stored.has_value() && !replica.empty()) {
    absl::StrAppend(&text,
                    "\nSessions that no request has reached since their server ended are in "
                    "the session store alone: spikectl store check counts them.");
  }
  return ServerAnswer{text, std::move(json)};
}

absl::StatusOr<ServerAnswer> Drain(const AdminFlags& flags) {
  v1::DrainRequest request;
  request.set_cancel(flags.cancel);
  ASSIGN_OR_RETURN(const auto response, CallAdmin(flags, &AdminStub::Drain, request));
  return ServerAnswer{
      absl::StrCat(request.cancel() ? "serving" : "draining",
                   ", open sessions: ", response.open_sessions()),
      {{"draining", !request.cancel()}, {"open_sessions", response.open_sessions()}}};
}

void AddPolicy(FlagGroup& group, AdminFlags* flags) {
  group.Add("policy", "NAME", &flags->policy, "Policy");
}

void AddVersion(FlagGroup& group, AdminFlags* flags) {
  AddPolicy(group, flags);
  group.Add("version", "N", &flags->version, "Version of the policy, from 1");
}

void AddNewDefault(FlagGroup& group, AdminFlags* flags) {
  AddPolicy(group, flags);
  group.Add("version", "N", &flags->version, "Version; 0: the highest, now and later");
}

void AddHeadVersion(FlagGroup& group, AdminFlags* flags) {
  AddPolicy(group, flags);
  group.Add("version", "N", &flags->version, "Version; 0: the default version");
  group.Add("tenant", "NAME", &flags->tenant, "Tenant of the head; default: that of the token");
}

void AddCorrections(FlagGroup& group, AdminFlags* flags) {
  group
      .Add("session", "ID", &flags->session, "Session with a head of its own, in place of --policy")
      .Add("operator", "NAME", &flags->operator_id, "Operator whose corrections are taken out")
      .Add("last", "DURATION", &flags->last, "How far back, 1s to 24h");
}

void AddLabel(FlagGroup& group, AdminFlags* flags) {
  group.Add("label", "NAME", &flags->label, "Name of a version, such as stable");
}

void AddTrafficFlags(FlagGroup& group, AdminFlags* flags) {
  AddPolicy(group, flags);
  group
      .AddList("shares", "VERSION:PERCENT,...", &flags->shares,
               "Shares of new sessions, or \"none\": all to the default version")
      .Add("shadow", "N", &flags->shadow, "Version that shadows the others; 0: none");
}

void AddFilter(FlagGroup& group, AdminFlags* flags) {
  group.Add("policy", "NAME", &flags->policy, "Policy; default: every one");
}

void AddMakeDefault(FlagGroup& group, AdminFlags* flags) {
  group.AddSwitch("make_default", &flags->make_default, "Also make the version the default");
}

// What a roll-out has besides its steps.
void AddRolloutLimits(FlagGroup& group, AdminFlags* flags) {
  group.Add("hold", "DURATION", &flags->hold, "Time that each step is held")
      .Add("min_episodes", "N", &flags->min_episodes,
           "Episodes of the new version in each step, at least")
      .AddList("abort_if", "MEASURE:MARGIN%,...", &flags->abort_if,
               "Ends the roll-out if worse by more")
      .Add("require_ope", "FILE", &flags->require_ope,
           "Report of spiketrain ope --json, without which it does not start");
}

void AddSteps(FlagGroup& group, AdminFlags* flags) {
  group.AddList("steps", "PERCENT,...", &flags->steps, "Shares of the new version");
}

void AddAbort(FlagGroup& group, AdminFlags* flags) {
  group.AddSwitch("abort", &flags->abort, "End the running roll-out");
}

void AddPush(FlagGroup& group, AdminFlags* flags) {
  group.AddArgument("file", "FILE", &flags->file, "Policy file to send");
  AddPolicy(group, flags);
  group.Add("version", "N", &flags->version, "Version, which is new; 0: the next one")
      .Add("signature", "FILE", &flags->signature, "Signature; default: that of FILE.sig, if any")
      .Add("tenant", "NAME", &flags->tenant, "Tenant that it counts to; default: the token's")
      .AddList("rollout", "PERCENT,...", &flags->rollout,
               "Steps of a roll-out that begins at once, such as 5,50,100");
}

void AddPull(FlagGroup& group, AdminFlags* flags) {
  group.AddArgument("file", "FILE", &flags->file, "Policy file to write");
  AddPolicy(group, flags);
  group.Add("version", "N", &flags->version, "Version; 0: the default version")
      .Add("signature", "FILE", &flags->signature, "Signature to write; default: FILE.sig");
}

void AddUsage(FlagGroup& group, AdminFlags* flags) {
  group.Add("month", "YYYY-MM", &flags->month, "Month of UTC; default: the running one")
      .AddList("by", "KEY,...", &flags->by, "Rows: tenant, policy, version, label, day or hour")
      .AddSwitch("csv", &flags->csv, "Print comma-separated values");
}

void AddLimit(FlagGroup& group, AdminFlags* flags) {
  group.Add("limit", "N", &flags->limit, "Entries to show, at most");
}

void AddWeights(FlagGroup& group, AdminFlags* flags) {
  group.AddSwitch("weights", &flags->weights, "Also print the weights; only with --json");
}

void AddAnyVersion(FlagGroup& group, AdminFlags* flags) {
  group.Add("version", "N", &flags->version, "Version; 0: every one");
}

void AddByNeed(FlagGroup& group, AdminFlags* flags) {
  group.AddSwitch("by_need", &flags->by_need, "Only sessions that need help, neediest first");
}

void AddCancel(FlagGroup& group, AdminFlags* flags) {
  group.AddSwitch("cancel", &flags->cancel, "Accept new sessions again");
}

struct AdminAction {
  const char* name;
  const char* summary;
  bool needs_policy;
  void (*add_flags[4])(FlagGroup& group, AdminFlags* flags);
  absl::StatusOr<ServerAnswer> (*run)(const AdminFlags& flags);
};

constexpr AdminAction kActions[] = {
    {"load", "Loads a version from its file", true, {AddVersion, AddMakeDefault}, Load},
    {"unload", "Stops serving a version to new sessions", true, {AddVersion}, Unload},
    {"default", "Makes a version the default", true, {AddNewDefault}, Default},
    {"label", "Names a version", true, {AddVersion, AddLabel}, Label},
    {"unlabel", "Removes the name of a version", true, {AddPolicy, AddLabel}, Unlabel},
    {"traffic",
     "Splits new sessions among versions, or shadows them",
     true,
     {AddTrafficFlags},
     Traffic},
    {"rollout",
     "Moves new sessions to a version step by step",
     true,
     {AddVersion, AddSteps, AddRolloutLimits, AddAbort},
     ChangeRollout},
    {"rollouts", "Shows the last roll-outs", false, {}, ShowRollouts},
    {"history", "Shows who changed what", false, {AddFilter, AddLimit}, ShowHistory},
    {"reload", "Looks for new, changed and removed policy files", false, {}, Reload},
    {"sessions", "Lists open sessions", false, {AddFilter, AddAnyVersion, AddByNeed}, Sessions},
    {"drain", "Refuses new sessions", false, {AddCancel}, Drain},
    {"head", "Shows the learned head of a fleet", true, {AddHeadVersion, AddWeights}, ShowHead},
    {"promote_head",
     "Writes and loads a version with the learned head",
     true,
     {AddHeadVersion, AddMakeDefault},
     PromoteHead},
    {"reset_head",
     "Forgets what a fleet has learned: the version's own head again",
     true,
     {AddHeadVersion},
     RollbackHead},
    {"undo_corrections",
     "Takes what an operator has taught out of a head",
     false,
     {AddHeadVersion, AddCorrections},
     UndoCorrections},
    {"pause_learning", "Pauses learning", false, {AddFilter}, PauseLearning},
    {"resume_learning", "Resumes learning", false, {AddFilter}, ResumeLearning},
};

// The actions that are commands of their own.
constexpr AdminAction kCommands[] = {
    {"usage",
     "Shows what was used in a month, and what is left of budgets",
     false,
     {AddUsage},
     ShowUsage},
    {"push",
     "Sends a version to all servers, and may roll it out",
     true,
     {AddPush, AddRolloutLimits, AddMakeDefault},
     PushVersion},
    {"pull", "Writes the file of a version", true, {AddPull}, PullVersion},
    {"rm", "Removes a version that was pushed", true, {AddVersion}, RemoveVersion},
};

// Names of earlier releases.
struct OldName {
  const char* name;
  const char* action;
  const char* hint;
};

constexpr OldName kOldNames[] = {
    {"rollback", "reset_head", "; to return to an earlier version: admin default --version=N"},
    {"promote", "promote_head", ""},
    {"pause", "pause_learning", ""},
    {"resume", "resume_learning", ""},
};

absl::Status RunAction(const AdminAction& action, const AdminFlags& flags) {
  if (action.needs_policy && flags.policy.empty()) {
    return InvalidArgument("--policy", "a name", "none");
  }
  return OnEveryServer(*flags.server, [&](const ServerFlags& server) {
    AdminFlags of_server = flags;
    of_server.server = &server;
    of_server.servers = flags.server;
    return action.run(of_server);
  });
}

// Adds the command `name`, which prints `note` on standard error and runs `action`.
Command AddAction(Command admin, const AdminAction& action, const char* name,
                  const std::string& note, const ServerFlags& server) {
  const Command command = admin.AddCommand(name, action.summary);
  const auto flags = std::make_shared<AdminFlags>();
  flags->server = &server;
  FlagGroup group = command.Flags("Action");
  for (const auto add : action.add_flags) {
    if (add != nullptr) add(group, flags.get());
  }
  command.SetAction([&action, note, flags] {
    std::cerr << note;
    return RunAction(action, *flags);
  });
  return command;
}

}  // namespace

void AddAdminCommands(Command program, const ServerFlags& server) {
  for (const AdminAction& action : kCommands) {
    AddAction(program, action, action.name, "", server);
  }
  const Command admin = program.AddCommand("admin", "Administers the server, or each of several");
  for (const AdminAction& action : kActions) {
    AddAction(admin, action, action.name, "", server);
    for (const OldName& old : kOldNames) {
      if (absl::string_view(old.action) != action.name) continue;
      const auto note = absl::StrCat("spikectl: admin ", old.name, " is called admin ", action.name,
                                     " now", old.hint, "\n");
      AddAction(admin, action, old.name, note, server).Hide();
    }
  }
}

}  // namespace spikeserve
