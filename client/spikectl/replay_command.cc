#include <cstdint>
#include <iostream>
#include <memory>
#include <string>

#include "absl/strings/str_cat.h"
#include "client/spikectl/agent_flags.h"
#include "client/spikectl/commands.h"
#include "client/spikectl/replay.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/dataset/recordings.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

struct ReplayFlags {
  std::string recording;
  PolicyFlags policy;
};

nlohmann::ordered_json ToJson(const std::string& recording, const ReplayResult& result) {
  nlohmann::ordered_json json = {{"recording", recording},
                                 {"policy", result.policy},
                                 {"version", result.version},
                                 {"episodes", result.episodes},
                                 {"decisions", result.decisions},
                                 {"identical", !result.difference.has_value()},
                                 {"steps_by_source", result.steps_by_source}};
  if (const auto& difference = result.difference) {
    json["difference"] = {{"episode", difference->episode},
                          {"step", difference->step},
                          {"field", difference->field},
                          {"recorded", difference->recorded},
                          {"replayed", difference->replayed}};
  }
  return json;
}

absl::Status ReplayRecording(const ReplayFlags& flags, const ServerFlags& server) {
  if (flags.recording.empty()) {
    return InvalidArgument("--recording", "a directory or a file", "none");
  }
  const auto episodes = ReadRecordings(flags.recording);
  if (!episodes.ok()) return Annotate(episodes.status(), "--recording");
  RETURN_IF_ERROR(CheckReplayable(*episodes));
  ASSIGN_OR_RETURN(const auto client, Connect(server));
  ASSIGN_OR_RETURN(const auto result,
                   Replay(*episodes, flags.policy.policy, flags.policy.version, *client));
  if (server.json) std::cout << ToJson(flags.recording, result).dump(2) << "\n";
  if (const auto& difference = result.difference) {
    return absl::AbortedError(absl::StrCat(
        result.policy, "/", result.version, " differs at episode ", difference->episode, ", step ",
        difference->step, ", after ", result.decisions, " equal decisions: ", difference->field,
        ": recorded ", difference->recorded.dump(), ", replayed ", difference->replayed.dump()));
  }
  if (!server.json) {
    std::cout << result.policy << "/" << result.version << ": " << result.decisions
              << " decisions of " << result.episodes << " episodes, all equal bit for bit\n";
    for (const auto& [source, steps] : result.steps_by_source) {
      if (steps < result.decisions) std::cout << "executed: " << steps << " of " << source << "\n";
    }
  }
  return absl::OkStatus();
}

}  // namespace

void AddReplayCommand(Command program, const ServerFlags& server) {
  const Command command =
      program.AddCommand("replay", "Replays a recorded session and compares each decision");
  const auto flags = std::make_shared<ReplayFlags>();
  FlagGroup replaying = command.Flags("Replaying");
  replaying.Add("recording", "FILE", &flags->recording,
                "Directory of a recorded session, or file of one episode");
  AddPolicyFlags(replaying, "the recorded one, in its version", &flags->policy);
  command.SetAction([flags, &server] { return ReplayRecording(*flags, server); });
}

}  // namespace spikeserve
