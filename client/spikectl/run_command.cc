#include <cstdint>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "client/spikectl/agent.h"
#include "client/spikectl/agent_flags.h"
#include "client/spikectl/commands.h"
#include "client/spikectl/run_report.h"

namespace spikeserve {
namespace {

struct RunFlags {
  AgentFlags agent;
  int episodes = 1;
  bool record = false;
};

absl::StatusOr<std::vector<EpisodeRecord>> PlayEpisodes(const RunFlags& flags,
                                                        Environment& environment,
                                                        RemoteSession& session, bool as_text) {
  std::vector<EpisodeRecord> episodes;
  for (int i = 0; i < flags.episodes; ++i) {
    const uint64_t seed = flags.agent.seed + static_cast<uint64_t>(i);
    auto episode = PlayEpisode(environment, session, seed);
    if (!episode.ok()) return episode.status();
    if (as_text) std::cout << RunTableLine(seed, *episode) << std::flush;
    episodes.push_back(*std::move(episode));
  }
  return episodes;
}

absl::Status Run(const RunFlags& flags, const ServerFlags& server) {
  if (flags.episodes < 1) {
    return absl::InvalidArgumentError(
        absl::StrCat("--episodes: expected at least 1, received ", flags.episodes));
  }
  const auto environment = MakeAgentEnvironment(flags.agent);
  if (!environment.ok()) return environment.status();
  const auto client = Connect(server);
  if (!client.ok()) return client.status();
  auto opened = OpenAgentSession(flags.agent, **environment, **client, flags.record);
  if (!opened.ok()) return opened.status();
  if (!opened->recording.empty()) {
    std::cerr << "spikectl: recorded as " << opened->recording << "\n";
  }

  // The energy model of `energy_joules` in the server's answers, see DecisionStats.
  const std::string energy_model = opened->policy.mode() == "dense" ? "horowitz_45nm" : "spike_5pj";
  const bool as_text = !server.json;
  if (as_text) {
    absl::PrintF("%s with policy %s/%d (%s)\n%s", flags.agent.env, opened->policy.name(),
                 opened->policy.version(), opened->policy.mode(), RunTableHead(energy_model));
  }
  const auto episodes = PlayEpisodes(flags, **environment, opened->session, as_text);
  const absl::Status closed = opened->session.Close();
  if (!episodes.ok()) return episodes.status();
  if (as_text) {
    std::cout << RunSummary(*episodes, energy_model);
  } else {
    std::cout << RunToJson(*episodes).dump(2) << "\n";
  }
  return closed;
}

}  // namespace

void AddRunCommand(Command program, const ServerFlags& server) {
  const Command command =
      program.AddCommand("run", "Plays episodes of an environment with the server's decisions");
  const auto flags = std::make_shared<RunFlags>();
  FlagGroup playing = command.Flags("Playing");
  AddAgentFlags(playing, &flags->agent);
  AddTargetReturn(playing, &flags->agent);
  playing.Add("episodes", "N", &flags->episodes, "Episodes to play")
      .AddSwitch("record", &flags->record, "Have the server record them in its --record_dir");
  command.SetAction([flags, &server] { return Run(*flags, server); });
}

}  // namespace spikeserve
