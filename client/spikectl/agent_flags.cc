#include "client/spikectl/agent_flags.h"

#include <cmath>

#include "client/spikectl/policy_choice.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {

void AddPolicyFlags(FlagGroup& group, const std::string& default_policy, PolicyFlags* flags) {
  group.Add("policy", "NAME", &flags->policy, "Policy; default: " + default_policy)
      .Add("version", "N", &flags->version, "Version of the policy; 0: its default version");
}

void AddAgentFlags(FlagGroup& group, AgentFlags* flags) {
  group.Add("env", "ID", &flags->env, "Gymnasium's name of the environment")
      .Add("seed", "N", &flags->seed, "Seed of the first episode; each later one adds 1");
  AddPolicyFlags(group, "the first one trained for --env", &flags->policy);
}

void AddTargetReturn(FlagGroup& group, AgentFlags* flags) {
  group.Add("target_return", "RETURN", &flags->target_return,
            "Target return; default: that of the policy");
}

absl::StatusOr<std::unique_ptr<Environment>> MakeAgentEnvironment(const AgentFlags& flags) {
  if (flags.policy.version < 0) {
    return InvalidArgument("--version", "at least 0", flags.policy.version);
  }
  if (flags.target_return.has_value() && !std::isfinite(*flags.target_return)) {
    return InvalidArgument("--target_return", "a finite number", *flags.target_return);
  }
  auto environment = MakeEnvironment(flags.env);
  if (!environment.ok()) return Annotate(environment.status(), "--env");
  return environment;
}

absl::StatusOr<OpenedSession> OpenAgentSession(const AgentFlags& flags,
                                               const Environment& environment, Client& client,
                                               const SessionFlags& session, bool reopens) {
  v1::OpenSessionRequest request;
  RETURN_IF_ERROR(FillRequest(session, &request));
  ASSIGN_OR_RETURN(const auto served, client.ListPolicies());
  auto policy = ChoosePolicy(served, flags.env, flags.policy.policy, flags.policy.version);
  if (!policy.ok()) return policy.status();
  RETURN_IF_ERROR(CheckSpacesMatch(*policy, environment));

  request.set_policy(policy->name());
  request.set_version(flags.policy.version);  // 0: the server chooses, so that shares apply
  request.set_seed(flags.seed);
  if (flags.target_return.has_value()) request.set_target_return(*flags.target_return);
  ASSIGN_OR_RETURN(auto opened, RemoteSession::Open(&client, std::move(request), reopens));
  const int64_t version = opened.opening().version();
  if (version != policy->version()) {
    policy = ChoosePolicy(served, flags.env, policy->name(), version);
    if (!policy.ok()) return policy.status();
  }
  std::string recording = opened.opening().recording();
  return OpenedSession{.policy = *std::move(policy),
                       .session = std::move(opened),
                       .recording = std::move(recording)};
}

}  // namespace spikeserve
