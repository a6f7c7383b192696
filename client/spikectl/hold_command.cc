#include <chrono>
#include <iostream>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_split.h"
#include "absl/time/clock.h"
#include "client/spikectl/commands.h"
#include "client/spikectl/operator_servers.h"
#include "client/spikectl/session_flags.h"
#include "core/base/status_macros.h"
#include "proto/json.h"

namespace spikeserve {

OperatorServers::OperatorServers(const ServerFlags& flags) {
  for (const absl::string_view address : absl::StrSplit(flags.server, ',')) {
    servers_.push_back({flags});
    servers_.back().flags.server = std::string(absl::StripAsciiWhitespace(address));
  }
}

namespace {

using nlohmann::ordered_json;

constexpr absl::Duration kPause = absl::Milliseconds(20);    // between two looks at the robots
constexpr absl::Duration kStoreTimeout = absl::Seconds(30);  // of a look at what a store has
constexpr int kHoldPageSize = 10000;                         // sessions
constexpr int kMostHoldPages = 100;

struct HoldFlags {
  const ServerFlags* server = nullptr;
  std::string id;
  std::string reason;
  std::string policy;
  int64_t version = 0;
  std::string tenant;
  std::vector<std::string> labels;    // KEY=VALUE
  std::vector<std::string> sessions;  // ids
  bool all = false;
  absl::Duration wait = absl::Seconds(2);
};

absl::StatusOr<v1::HoldSessionsRequest> HoldRequest(const HoldFlags& flags) {
  v1::HoldSessionsRequest request;
  request.set_id(flags.id);
  request.set_reason(flags.reason);
  v1::SessionSelection& selection = *request.mutable_selection();
  selection.set_policy(flags.policy);
  selection.set_version(flags.version);
  selection.set_tenant(flags.tenant);
  selection.set_all(flags.all);
  selection.mutable_session_ids()->Add(flags.sessions.begin(), flags.sessions.end());
  RETURN_IF_ERROR(AddLabels("--label", flags.labels, selection.mutable_labels()));
  return request;
}

// What the servers know of the robots of a hold.
struct HeldRobots {
  std::map<std::pair<std::string, std::string>, v1::HeldSession> robots;  // by tenant and id
  // Servers that did not answer or have no such hold, and why.
  std::map<std::string, std::string> unreached = {};

  std::vector<const v1::HeldSession*> NotConfirmed() const {
    std::vector<const v1::HeldSession*> robots_left;
    for (const auto& [key, robot] : robots) {
      if (!robot.at_neutral()) robots_left.push_back(&robot);
    }
    return robots_left;
  }
};

// `refusals[i]` says why server i has refused the hold. `stored`: also at the sessions that only a
// store has.
HeldRobots LookAtRobots(OperatorServers& servers, const std::string& id,
                        const std::vector<absl::Status>& refusals, bool stored) {
  HeldRobots state;
  std::vector<std::string> tokens(servers.size());
  bool goes_on = true;
  for (int page = 0; goes_on && page < kMostHoldPages; ++page) {
    goes_on = false;
    const auto pages = servers.AtEach<v1::ListHoldsRequest, v1::ListHoldsResponse>(
        &AdminStub::ListHolds,
        [&](size_t i) {
          v1::ListHoldsRequest request;
          request.set_id(id);
          request.set_page_size(kHoldPageSize);
          request.set_page_token(tokens[i]);
          request.set_stored(stored);
          return request;
        },
        stored ? kStoreTimeout : OperatorServers::kTimeout);
    for (size_t i = 0; i < pages.size(); ++i) {
      const absl::Status& why = pages[i].ok() ? refusals[i] : pages[i].status();
      if (!pages[i].ok() || pages[i]->holds().empty()) {
        state.unreached[servers.address(i)] =
            why.ok() ? "no such hold" : std::string(why.message());
        continue;
      }
      for (const v1::HeldSession& session : pages[i]->sessions()) {
        v1::HeldSession& robot = state.robots[{session.tenant(), session.session_id()}];
        const bool is_newer = robot.only_stored() || robot.epoch() < session.epoch();
        if (robot.session_id().empty() || (is_newer && !session.only_stored())) robot = session;
      }
      const std::string& next = pages[i]->next_page_token();
      goes_on = goes_on || next > tokens[i];
      tokens[i] = std::max(next, tokens[i]);
    }
  }
  return state;
}

void Print(const v1::HoldSessionsResponse& held, const HeldRobots& state, bool json) {
  const auto left = state.NotConfirmed();
  if (json) {
    ordered_json robots = ordered_json::array();
    for (const auto& [key, robot] : state.robots) {
      robots.push_back(MessageToFields(robot, Numbers::kExact));
    }
    std::cout << ordered_json{{"id", held.hold().hold().id()},
                              {"kept", held.kept()},
                              {"robots", robots},
                              {"not_confirmed", left.size()},
                              {"unreached", state.unreached}}
                     .dump(2)
              << "\n";
    return;
  }
  std::cout << held.hold().hold().id() << ": " << state.robots.size() - left.size() << " of "
            << state.robots.size() << " robots at their neutral action\n";
  for (const v1::HeldSession* robot : left) {
    const std::string contact =
        robot->only_stored() ? "in the store alone: has asked no server since its own ended"
                             : absl::StrFormat("last contact %.1f s ago%s", robot->idle_seconds(),
                                               robot->silent() ? ", silent" : "");
    std::cout << absl::StrFormat("not confirmed: %s %s/%d %s, %s\n", robot->session_id(),
                                 robot->policy(), robot->version(), robot->tenant(), contact);
  }
  for (const auto& [server, why] : state.unreached) {
    std::cout << "not reached: " << server << ": " << why << "\n";
  }
  if (!held.kept()) {
    std::cout << "ends with the server, which has no --policy_settings and shares no store\n";
  }
}

absl::Status HoldRobots(const HoldFlags& flags) {
  ASSIGN_OR_RETURN(auto request, HoldRequest(flags));
  OperatorServers servers(*flags.server);
  if (request.id().empty()) {
    // One id at all servers, so that they hold once.
    request.set_id(absl::StrCat("hold-", absl::ToUnixNanos(absl::Now())));
  }
  const auto answers = servers.AtEach<v1::HoldSessionsRequest, v1::HoldSessionsResponse>(
      &AdminStub::HoldSessions, [&](size_t) { return request; });
  std::optional<v1::HoldSessionsResponse> held;
  std::vector<absl::Status> refusals;
  for (const auto& answer : answers) {
    refusals.push_back(answer.status());
    if (!answer.ok()) continue;
    const bool all_keep = answer->kept() && (!held.has_value() || held->kept());
    held = *answer;
    held->set_kept(all_keep);
  }
  if (!held.has_value()) return answers[0].status();
  const absl::Time end = absl::Now() + flags.wait;
  HeldRobots state = LookAtRobots(servers, request.id(), refusals, false);
  while ((!state.NotConfirmed().empty() || !state.unreached.empty()) && absl::Now() < end) {
    absl::SleepFor(kPause);
    state = LookAtRobots(servers, request.id(), refusals, false);
  }
  state = LookAtRobots(servers, request.id(), refusals, true);
  Print(*held, state, flags.server->json);
  const size_t left = state.NotConfirmed().size();
  if (left == 0 && state.unreached.empty()) return absl::OkStatus();
  return absl::UnavailableError(absl::StrCat(left, " robots are not known to be at neutral, and ",
                                             state.unreached.size(), " servers were not reached"));
}

std::string Describe(const v1::SessionSelection& selection) {
  std::vector<std::string> parts;
  if (selection.all()) parts.emplace_back("all");
  if (!selection.policy().empty()) parts.push_back(absl::StrCat("policy ", selection.policy()));
  if (selection.version() > 0) parts.push_back(absl::StrCat("version ", selection.version()));
  if (!selection.tenant().empty()) parts.push_back(absl::StrCat("tenant ", selection.tenant()));
  for (const auto& [key, value] : selection.labels()) {
    parts.push_back(absl::StrCat("label ", key, "=", value));
  }
  if (selection.session_ids_size() > 0) {
    parts.push_back(absl::StrCat("sessions ", absl::StrJoin(selection.session_ids(), ",")));
  }
  return absl::StrJoin(parts, ", ");
}

absl::StatusOr<ServerAnswer> Resume(const HoldFlags& flags, const ServerFlags& server) {
  v1::ResumeSessionsRequest request;
  request.set_id(flags.id);
  ASSIGN_OR_RETURN(const auto admin, ConnectAdmin(server));
  ASSIGN_OR_RETURN(const auto resumed, admin->Call(&AdminStub::ResumeSessions, request));
  return ServerAnswer{
      absl::StrCat("resumed ", flags.id, ": ", Describe(resumed.hold().selection())),
      {{"id", flags.id}, {"sessions", resumed.hold().sessions()}},
      resumed.shared()};
}

absl::StatusOr<ServerAnswer> ShowHolds(const ServerFlags& server) {
  ASSIGN_OR_RETURN(const auto admin, ConnectAdmin(server));
  ASSIGN_OR_RETURN(const auto list, admin->Call(&AdminStub::ListHolds, v1::ListHoldsRequest()));
  std::vector<std::string> lines;
  ordered_json holds = ordered_json::array();
  for (const v1::HeldSelection& held : list.holds()) {
    const std::string selection = Describe(held.selection());
    const absl::Time since = absl::UnixEpoch() + absl::Seconds(held.since());
    lines.push_back(absl::StrCat(held.hold().id(), ": ", selection, "; ", held.sessions(),
                                 " sessions, since ",
                                 absl::FormatTime("%Y-%m-%dT%H:%M:%SZ", since, absl::UTCTimeZone()),
                                 "; ", held.hold().reason()));
    holds.push_back({{"id", held.hold().id()},
                     {"reason", held.hold().reason()},
                     {"selection", selection},
                     {"sessions", held.sessions()},
                     {"since", held.since()}});
  }
  return ServerAnswer{lines.empty() ? "no holds" : absl::StrJoin(lines, "\n"), {{"holds", holds}}};
}

}  // namespace

void AddHoldCommands(Command program, const ServerFlags& server) {
  const Command hold =
      program.AddCommand("hold", "Keeps robots at their safe action. No safety function");
  const auto flags = std::make_shared<HoldFlags>();
  flags->server = &server;
  hold.Flags("Action")
      .Add("policy", "NAME", &flags->policy, "Policy of the sessions")
      .Add("version", "N", &flags->version, "Version of the policy")
      .Add("tenant", "NAME", &flags->tenant, "Tenant; default: that of the token, or every one")
      .AddList("label", "KEY=VALUE,...", &flags->labels, "Labels of the sessions, all of them")
      .AddList("session", "ID,...", &flags->sessions, "Sessions, one of them")
      .AddSwitch("all", &flags->all, "All sessions, without another condition")
      .Add("reason", "TEXT", &flags->reason, "Why, for people")
      .Add("id", "NAME", &flags->id, "Name of the hold; default: a new one")
      .Add("wait", "DURATION", &flags->wait, "Time for all robots to be at their neutral action");
  hold.SetAction([flags] { return HoldRobots(*flags); });

  const Command resume = program.AddCommand("resume", "Ends a hold");
  const auto resumed = std::make_shared<HoldFlags>();
  resume.Flags("Action").Add("id", "NAME", &resumed->id, "Name of the hold");
  resume.SetAction([resumed, &server] {
    return OnEveryServer(server, [&](const ServerFlags& one) { return Resume(*resumed, one); });
  });

  program.AddCommand("holds", "Lists the holds").SetAction([&server] {
    return OnEveryServer(server, ShowHolds);
  });
}

}  // namespace spikeserve
