#include <cstdint>
#include <iostream>
#include <string>
#include <vector>

#include "absl/flags/flag.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "client/spikectl/agent.h"
#include "client/spikectl/agent_flags.h"
#include "client/spikectl/commands.h"
#include "client/spikectl/common_flags.h"
#include "client/spikectl/run_report.h"

ABSL_FLAG(int32_t, episodes, 1, "Episodes to play");
ABSL_FLAG(bool, record, false, "Has the server record the episodes below its --record_dir");

namespace spikeserve {
namespace {

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
  if (const int32_t episodes = absl::GetFlag(FLAGS_episodes); episodes < 1) {
    return absl::InvalidArgumentError(
        absl::StrCat("--episodes: expected at least 1, received ", episodes));
  }
  const auto environment = EnvironmentFromFlags();
  if (!environment.ok()) return environment.status();
  const auto client = ConnectToServer();
  if (!client.ok()) return client.status();
  auto opened = OpenSessionFromFlags(**environment, **client, absl::GetFlag(FLAGS_record));
  if (!opened.ok()) return opened.status();
  if (!opened->recording.empty()) {
    std::cerr << "spikectl: recorded as " << opened->recording << "\n";
  }

  // What the server reports as energy_joules, see DecisionStats.
  const std::string energy_model = opened->policy.mode() == "dense" ? "horowitz_45nm" : "spike_5pj";
  const bool as_text = !absl::GetFlag(FLAGS_json);
  if (as_text) {
    absl::PrintF("%s with policy %s/%d (%s)\n%s", absl::GetFlag(FLAGS_env), opened->policy.name(),
                 opened->policy.version(), opened->policy.mode(), RunTableHead(energy_model));
  }
  const auto episodes = PlayEpisodes(**environment, opened->session, as_text);
  const absl::Status closed = opened->session.Close();
  if (!episodes.ok()) return episodes.status();
  if (as_text) {
    std::cout << RunSummary(*episodes, energy_model);
  } else {
    std::cout << RunToJson(*episodes).dump(2) << "\n";
  }
  return closed;
}

}  // namespace spikeserve
