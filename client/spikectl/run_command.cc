#include <cmath>
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
#include "client/spikectl/distance.h"
#include "client/spikectl/run_report.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "spikeserve/status.h"

namespace spikeserve {
namespace {

constexpr int kTries = 3;  // of an episode whose session is lost
constexpr int kProgressDots = 60;

struct RunFlags {
  AgentFlags agent;
  SessionFlags session;
  PlayOptions play;
  int episodes = 1;
  bool quiet = false;
  bool reopen = false;
};

// Plays an episode, again from its start if its session was lost and replaced on the way.
absl::StatusOr<EpisodeRecord> PlayWhole(Environment& environment, RemoteSession& session,
                                        uint64_t seed, const PlayOptions& options) {
  for (int i = 0; i < kTries; ++i) {
    const int before = session.reopened();
    auto episode = PlayEpisode(environment, session, seed, options);
    const bool is_whole = session.reopened() == before;
    if (is_whole || !(episode.ok() || IsSessionLost(episode.status()))) return episode;
  }
  return absl::NotFoundError(absl::StrCat("the session was lost in each of ", kTries,
                                          " tries of the episode with seed ", seed));
}

// Shows that the episode of index `i` has ended, as a line of the table or on a line of at most
// kProgressDots dots.
void ShowProgress(const RunFlags& flags, int i, uint64_t seed, const EpisodeRecord& episode) {
  if (!flags.quiet) {
    std::cout << RunTableLine(seed, episode) << std::flush;
  } else if (i % ((flags.episodes + kProgressDots - 1) / kProgressDots) == 0) {
    std::cout << '.' << std::flush;
  }
}

// Plays the episodes and appends them to `episodes`, up to the first error, which is returned.
absl::Status PlayEpisodes(const RunFlags& flags, Environment& environment, RemoteSession& session,
                          bool as_text, std::vector<EpisodeRecord>* episodes) {
  for (int i = 0; i < flags.episodes; ++i) {
    const uint64_t seed = flags.agent.seed + static_cast<uint64_t>(i);
    ASSIGN_OR_RETURN(auto episode, PlayWhole(environment, session, seed, flags.play));
    if (as_text) ShowProgress(flags, i, seed, episode);
    episodes->push_back(std::move(episode));
  }
  return absl::OkStatus();
}

// Returns `error` with what was played before it.
absl::Status Stopped(const absl::Status& error, size_t ended, int wanted) {
  return absl::Status(error.code(), absl::StrCat("stopped after ", ended, " of ", wanted,
                                                 " episodes: ", error.message()));
}

absl::Status Run(const RunFlags& flags, const ServerFlags& server) {
  if (flags.episodes < 1) {
    return InvalidArgument("--episodes", "at least 1", flags.episodes);
  }
  if (!std::isfinite(flags.play.rate) || flags.play.rate < 0.0) {
    return InvalidArgument("--rate", "decisions a second of at least 0", flags.play.rate);
  }
  RETURN_IF_ERROR(flags.play.distance.Validate());
  ASSIGN_OR_RETURN(const auto environment, MakeAgentEnvironment(flags.agent));
  ASSIGN_OR_RETURN(const auto client, Connect(server));
  ASSIGN_OR_RETURN(auto opened, OpenAgentSession(flags.agent, *environment, *client, flags.session,
                                                 flags.reopen));
  if (!opened.recording.empty()) {
    std::cerr << "spikectl: recorded as " << opened.recording << "\n";
  }

  const bool as_text = !server.json;
  if (as_text) {
    std::cout << absl::StrFormat("%s with policy %s/%d (%s)", flags.agent.env, opened.policy.name(),
                                 opened.policy.version(), opened.policy.mode())
              << (flags.quiet ? " " : "\n" + RunTableHead()) << std::flush;
  }
  std::vector<EpisodeRecord> episodes;
  const absl::Status played = PlayEpisodes(flags, *environment, opened.session, as_text, &episodes);
  if (as_text && flags.quiet) std::cout << std::endl;
  if (!episodes.empty()) {
    if (as_text) {
      std::cout << RunSummary(episodes);
    } else {
      std::cout << RunToJson(episodes).dump(2) << "\n";
    }
    std::cout << std::flush;
  }
  // A session that cannot be played on cannot be closed either, or ends by itself.
  if (!played.ok()) return Stopped(played, episodes.size(), flags.episodes);
  return opened.session.Close();
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
      .AddSwitch("quiet", &flags->quiet, "Print a dot for an episode instead of a line");
  AddSessionFlags(command, &flags->session);
  FlagGroup far = command.Flags("Advanced: pace and distance");
  far.Add("rate", "HZ", &flags->play.rate, "Decisions a second; 0: as many as it can");
  far.AddSwitch("reopen", &flags->reopen,
                "Play an episode again in a new session if the server lost it");
  AddDistanceFlags(far, &flags->play.distance);
  command.SetAction([flags, &server] { return Run(*flags, server); });
}

}  // namespace spikeserve
