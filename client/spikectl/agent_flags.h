// The flags that say what an agent plays, and with which policy: --env, --seed, --policy, --version
// and --target_return.
#ifndef CLIENT_SPIKECTL_AGENT_FLAGS_H_
#define CLIENT_SPIKECTL_AGENT_FLAGS_H_

#include <cstdint>
#include <memory>
#include <string>

#include "absl/flags/declare.h"
#include "absl/status/statusor.h"
#include "core/environment/environment.h"
#include "spikeserve/client.h"
#include "spikeserve/remote_session.h"

ABSL_DECLARE_FLAG(std::string, env);
ABSL_DECLARE_FLAG(uint64_t, seed);

namespace spikeserve {

// The environment of --env. INVALID_ARGUMENT names the flag that is wrong, whichever it is.
absl::StatusOr<std::unique_ptr<Environment>> EnvironmentFromFlags();

struct OpenedSession {
  v1::PolicyInfo policy;
  RemoteSession session;
  std::string recording;  // where the server keeps its episodes; empty where it does not
};

// A session with the policy that the flags ask for, recorded if `record`. `client` must outlive it.
// NOT_FOUND if there is no such policy, INVALID_ARGUMENT if it does not fit `environment`; errors
// of the calls.
absl::StatusOr<OpenedSession> OpenSessionFromFlags(const Environment& environment, Client& client,
                                                   bool record = false);

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_AGENT_FLAGS_H_
