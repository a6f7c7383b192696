#include <cstdint>
#include <iostream>
#include <memory>
#include <string>

#include "client/spikectl/agent.h"
#include "client/spikectl/agent_flags.h"
#include "client/spikectl/commands.h"
#include "client/spikectl/explain_report.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "proto/json.h"

namespace spikeserve {
namespace {

constexpr char kPlaying[] = "Playing, without --session";

struct ExplainFlags {
  std::string session;  // empty: plays a new session
  AgentFlags agent;
  int steps = 20;
};

// Plays a new session and explains its last decision.
absl::StatusOr<v1::ExplainResponse> PlayAndExplain(const ExplainFlags& flags,
                                                   Environment& environment, Client& client) {
  ASSIGN_OR_RETURN(auto opened, OpenAgentSession(flags.agent, environment, client));
  RemoteSession& session = opened.session;
  const absl::Status played = PlaySteps(environment, session, flags.agent.seed, flags.steps);
  auto explained = played.ok() ? session.Explain() : absl::StatusOr<v1::ExplainResponse>(played);
  const absl::Status closed = session.Close();
  if (explained.ok() && !closed.ok()) return closed;
  return explained;
}

// Returns what the server says about the policy of a decision; nothing if it does not serve it.
v1::PolicyInfo PolicyOf(const v1::ExplainResponse& explained, Client& client) {
  const auto listed = client.ListPolicies();
  if (!listed.ok()) return {};
  for (const v1::PolicyInfo& policy : listed->policies()) {
    if (policy.name() == explained.policy() && policy.version() == explained.version()) {
      return policy;
    }
  }
  return {};
}

absl::Status Explain(const ExplainFlags& flags, const ServerFlags& server) {
  if (flags.steps < 1) {
    return InvalidArgument("--steps", "at least 1", flags.steps);
  }
  ASSIGN_OR_RETURN(const auto environment, MakeAgentEnvironment(flags.agent));
  ASSIGN_OR_RETURN(const auto client, Connect(server));
  ASSIGN_OR_RETURN(const auto explained, flags.session.empty()
                                             ? PlayAndExplain(flags, *environment, *client)
                                             : client->Explain(flags.session));
  if (!server.json) {
    const v1::PolicyInfo policy = PolicyOf(explained, *client);
    ASSIGN_OR_RETURN(const std::string text, ExplainToText(explained, policy));
    std::cout << text;
    return absl::OkStatus();
  }
  std::cout << MessageToFields(explained).dump() << "\n";
  return absl::OkStatus();
}

}  // namespace

void AddExplainCommand(Command program, const ServerFlags& server) {
  const Command command =
      program.AddCommand("explain", "Shows the spikes, gates and attention of a decision");
  const auto flags = std::make_shared<ExplainFlags>();
  command.Flags("Session").Add("session", "ID", &flags->session,
                               "Session to explain; default: plays a new session");
  FlagGroup playing = command.Flags(kPlaying);
  AddAgentFlags(playing, &flags->agent);
  AddTargetReturn(playing, &flags->agent);
  playing.Add("steps", "N", &flags->steps, "Decisions, the last of which is explained");
  command.RefuseBeside("session", kPlaying);
  command.SetAction([flags, &server] { return Explain(*flags, server); });
}

}  // namespace spikeserve
