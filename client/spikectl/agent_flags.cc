#include "client/spikectl/agent_flags.h"

#include <cmath>

#include "absl/flags/flag.h"
#include "absl/strings/str_cat.h"
#include "absl/types/optional.h"
#include "client/spikectl/policy_choice.h"

ABSL_FLAG(std::string, env, "CartPole-v1", "Gymnasium's id of the environment to play");
ABSL_FLAG(uint64_t, seed, 0,
          "Seed of the first episode's start; the next episodes count on from it");
ABSL_FLAG(std::string, policy, "",
          "Policy to ask for; empty: the first by name that was trained for --env; replay: the "
          "recorded one");
ABSL_FLAG(int64_t, version, 0,
          "Version of the policy; 0: its default one; replay without --policy: the recorded one");
ABSL_FLAG(absl::optional<double>, target_return, absl::nullopt,
          "Return to ask of the policy; unset: the policy's own");

namespace spikeserve {

absl::StatusOr<std::unique_ptr<Environment>> EnvironmentFromFlags() {
  if (const int64_t version = absl::GetFlag(FLAGS_version); version < 0) {
    return absl::InvalidArgumentError(
        absl::StrCat("--version: expected at least 0, received ", version));
  }
  const absl::optional<double> target_return = absl::GetFlag(FLAGS_target_return);
  if (target_return.has_value() && !std::isfinite(*target_return)) {
    return absl::InvalidArgumentError(
        absl::StrCat("--target_return: expected a finite number, received ", *target_return));
  }
  auto environment = MakeEnvironment(absl::GetFlag(FLAGS_env));
  if (!environment.ok()) {
    return absl::Status(environment.status().code(),
                        absl::StrCat("--env: ", environment.status().message()));
  }
  return environment;
}

absl::StatusOr<OpenedSession> OpenSessionFromFlags(const Environment& environment, Client& client,
                                                   bool record) {
  const auto served = client.ListPolicies();
  if (!served.ok()) return served.status();
  const auto policy = ChoosePolicy(*served, absl::GetFlag(FLAGS_env), absl::GetFlag(FLAGS_policy),
                                   absl::GetFlag(FLAGS_version));
  if (!policy.ok()) return policy.status();
  if (absl::Status status = CheckFits(*policy, environment); !status.ok()) return status;

  v1::OpenSessionRequest request;
  request.set_policy(policy->name());
  request.set_version(policy->version());
  request.set_seed(absl::GetFlag(FLAGS_seed));
  if (const auto target_return = absl::GetFlag(FLAGS_target_return); target_return.has_value()) {
    request.set_target_return(*target_return);
  }
  request.set_record(record);
  const auto opened = client.OpenSession(request);
  if (!opened.ok()) return opened.status();
  return OpenedSession{.policy = *policy,
                       .session = RemoteSession(&client, opened->session_id(), 0),
                       .recording = opened->recording()};
}

}  // namespace spikeserve
