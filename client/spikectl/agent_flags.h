// The flags that select the environment and the policy of an agent.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "client/spikectl/session_flags.h"
#include "core/cli/flag_group.h"
#include "core/environment/environment.h"
#include "spikeserve/client.h"
#include "spikeserve/remote_session.h"

namespace spikeserve {

struct PolicyFlags {
  std::string policy;   // empty: the default of the command
  int64_t version = 0;  // 0: the policy's default version
};

struct AgentFlags {
  std::string env = "CartPole-v1";
  uint64_t seed = 0;  // of the first episode; each later episode adds 1
  PolicyFlags policy;
  std::optional<double> target_return;  // absent: the default of the policy
};

// Adds --policy and --version. `default_policy` describes the default of --policy in the help.
void AddPolicyFlags(FlagGroup& group, const std::string& default_policy, PolicyFlags* flags);

// Adds --env, --seed, --policy and --version.
void AddAgentFlags(FlagGroup& group, AgentFlags* flags);

// Adds --target_return.
void AddTargetReturn(FlagGroup& group, AgentFlags* flags);

// Creates the environment of --env. Returns INVALID_ARGUMENT, which names the flag, if --env or
// --target_return is invalid.
absl::StatusOr<std::unique_ptr<Environment>> MakeAgentEnvironment(const AgentFlags& flags);

struct OpenedSession {
  v1::PolicyInfo policy;  // the version that the session was opened on
  RemoteSession session;
  std::string recording;  // path of its recording on the server; empty if it is not recorded
};

// Opens a session with the policy of `flags` and the options of `session`. If `reopens`, a lost
// session is replaced by a new one (RemoteSession::Open). `client` must outlive the session.
// Returns NOT_FOUND if there is no such policy, INVALID_ARGUMENT if it does not fit `environment`,
// and the errors of the calls.
absl::StatusOr<OpenedSession> OpenAgentSession(const AgentFlags& flags,
                                               const Environment& environment, Client& client,
                                               const SessionFlags& session = {},
                                               bool reopens = false);

}  // namespace spikeserve
