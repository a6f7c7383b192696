// The flags that say what an agent plays, and with which policy.
#ifndef CLIENT_SPIKECTL_AGENT_FLAGS_H_
#define CLIENT_SPIKECTL_AGENT_FLAGS_H_

#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "core/cli/flag_group.h"
#include "core/environment/environment.h"
#include "spikeserve/client.h"
#include "spikeserve/remote_session.h"

namespace spikeserve {

struct PolicyFlags {
  std::string policy;   // empty: see each command
  int64_t version = 0;  // 0: the policy's default version
};

struct AgentFlags {
  std::string env = "CartPole-v1";
  uint64_t seed = 0;  // of the first episode; the next episodes count on from it
  PolicyFlags policy;
  std::optional<double> target_return;  // absent: the policy's own
};

// Adds --policy and --version. `default_policy` says what an empty --policy stands for.
void AddPolicyFlags(FlagGroup& group, const std::string& default_policy, PolicyFlags* flags);

// Adds --env, --seed, --policy and --version.
void AddAgentFlags(FlagGroup& group, AgentFlags* flags);

// Adds --target_return.
void AddTargetReturn(FlagGroup& group, AgentFlags* flags);

// Returns the environment of --env. INVALID_ARGUMENT names the flag that is wrong, whichever it is.
absl::StatusOr<std::unique_ptr<Environment>> MakeAgentEnvironment(const AgentFlags& flags);

struct OpenedSession {
  v1::PolicyInfo policy;
  RemoteSession session;
  std::string recording;  // where the server keeps its episodes; empty where it does not
};

// Opens a session with the policy that `flags` ask for, recorded if `record`. `client` must outlive
// it. NOT_FOUND if there is no such policy, INVALID_ARGUMENT if it does not fit `environment`;
// errors of the calls.
absl::StatusOr<OpenedSession> OpenAgentSession(const AgentFlags& flags,
                                               const Environment& environment, Client& client,
                                               bool record = false);

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_AGENT_FLAGS_H_
