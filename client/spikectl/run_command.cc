#include <cmath>
#include <cstdint>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

#include "absl/flags/flag.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/types/optional.h"
#include "client/spikectl/agent.h"
#include "client/spikectl/commands.h"
#include "client/spikectl/common_flags.h"
#include "client/spikectl/policy_choice.h"
#include "client/spikectl/run_report.h"

ABSL_FLAG(std::string, env, "CartPole-v1", "Gymnasium's id of the environment to play");
ABSL_FLAG(int32_t, episodes, 1, "Episodes to play");
ABSL_FLAG(uint64_t, seed, 0,
          "Seed of the first episode's start; the next episodes count on from it");
ABSL_FLAG(
    std::string, policy, "",
    "Policy to ask for; empty: run: the first by name that was trained for --env; replay: the "
    "recorded one");
ABSL_FLAG(int64_t, version, 0,
          "Version of the policy; 0: its default one; replay without --policy: the recorded one");
ABSL_FLAG(absl::optional<double>, target_return, absl::nullopt,
          "Return to ask of the policy; unset: the policy's own");

ABSL_FLAG(bool, record, false, "Has the server record the episodes below its --record_dir");

namespace spikeserve {
namespace {

absl::Status CheckFlags() {
  if (const int32_t episodes = absl::GetFlag(FLAGS_episodes); episodes < 1) {
    return absl::InvalidArgumentError(
        absl::StrCat("--episodes: expected at least 1, got ", episodes));
  }
  if (const int64_t version = absl::GetFlag(FLAGS_version); version < 0) {
    return absl::InvalidArgumentError(
        absl::StrCat("--version: expected at least 0, got ", version));
  }
  const absl::optional<double> target_return = absl::GetFlag(FLAGS_target_return);
  if (target_return.has_value() && !std::isfinite(*target_return)) {
    return absl::InvalidArgumentError(
        absl::StrCat("--target_return: expected a finite number, got ", *target_return));
  }
  return absl::OkStatus();
}

// A session with the policy that the flags ask for.
absl::StatusOr<RemoteSession> OpenSession(Client& client, const v1::PolicyInfo& policy) {
  v1::OpenSessionRequest request;
  request.set_policy(policy.name());
  request.set_version(policy.version());
  request.set_seed(absl::GetFlag(FLAGS_seed));
  if (const auto target_return = absl::GetFlag(FLAGS_target_return); target_return.has_value()) {
    request.set_target_return(*target_return);
  }
  request.set_record(absl::GetFlag(FLAGS_record));
  const auto opened = client.OpenSession(request);
  if (!opened.ok()) return opened.status();
  if (!opened->recording().empty())
    std::cerr << "spikectl: recorded as " << opened->recording() << "\n";
  return RemoteSession(&client, opened->session_id(), 0);
}

absl::StatusOr<std::vector<EpisodeRecord>> PlayEpisodes(Environment& environment,
                                                        RemoteSession& session, bool as_text) {
  std::vector<EpisodeRecord> episodes;
  for (int i = 0; i < absl::GetFlag(FLAGS_episodes); ++i) {
    const uint64_t seed = absl::GetFlag(FLAGS_seed) + static_cast<uint64_t>(i);
    auto episode = PlayEpisode(environment, session, seed);
    if (!episode.ok()) return episode.status();
    if (as_text) std::cout << RunTableLine(seed, *episode) << std::flush;
    episodes.push_back(*std::move(episode));
  }
  return episodes;
}

}  // namespace

absl::Status RunCommand() {
  if (absl::Status status = CheckFlags(); !status.ok()) return status;
  const auto environment = MakeEnvironment(absl::GetFlag(FLAGS_env));
  if (!environment.ok()) {
    return absl::Status(environment.status().code(),
                        absl::StrCat("--env: ", environment.status().message()));
  }
  const auto client = ConnectToServer();
  if (!client.ok()) return client.status();
  const auto served = (*client)->ListPolicies();
  if (!served.ok()) return served.status();
  const auto policy = ChoosePolicy(*served, absl::GetFlag(FLAGS_env), absl::GetFlag(FLAGS_policy),
                                   absl::GetFlag(FLAGS_version));
  if (!policy.ok()) return policy.status();
  if (absl::Status status = CheckFits(*policy, **environment); !status.ok()) return status;
  auto session = OpenSession(**client, *policy);
  if (!session.ok()) return session.status();

  // What the server reports as energy_joules, see DecisionStats.
  const std::string energy_model = policy->mode() == "dense" ? "horowitz_45nm" : "spike_5pj";
  const bool as_text = !absl::GetFlag(FLAGS_json);
  if (as_text) {
    absl::PrintF("%s with policy %s/%d (%s)\n%s", absl::GetFlag(FLAGS_env), policy->name(),
                 policy->version(), policy->mode(), RunTableHead(energy_model));
  }
  const auto episodes = PlayEpisodes(**environment, *session, as_text);
  const absl::Status closed = session->Close();
  if (!episodes.ok()) return episodes.status();
  if (as_text) {
    std::cout << RunSummary(*episodes, energy_model);
  } else {
    std::cout << RunToJson(*episodes).dump(2) << "\n";
  }
  return closed;
}

}  // namespace spikeserve
