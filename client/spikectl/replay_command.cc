#include <cstdint>
#include <iostream>
#include <string>

#include "absl/flags/declare.h"
#include "absl/flags/flag.h"
#include "absl/strings/str_cat.h"
#include "client/spikectl/commands.h"
#include "client/spikectl/common_flags.h"
#include "client/spikectl/replay.h"
#include "core/dataset/recordings.h"
#include "nlohmann/json.hpp"

ABSL_FLAG(std::string, recording, "",
          "Directory of a recorded session, or the file of one of its episodes");
ABSL_DECLARE_FLAG(std::string, policy);
ABSL_DECLARE_FLAG(int64_t, version);

namespace spikeserve {
namespace {

nlohmann::ordered_json ToJson(const std::string& recording, const ReplayResult& result) {
  nlohmann::ordered_json json = {
      {"recording", recording},        {"policy", result.policy},
      {"version", result.version},     {"episodes", result.episodes},
      {"decisions", result.decisions}, {"identical", !result.difference.has_value()}};
  if (const auto& difference = result.difference) {
    json["difference"] = {{"episode", difference->episode},
                          {"step", difference->step},
                          {"field", difference->field},
                          {"recorded", difference->recorded},
                          {"replayed", difference->replayed}};
  }
  return json;
}

}  // namespace

absl::Status ReplayCommand() {
  const std::string recording = absl::GetFlag(FLAGS_recording);
  if (recording.empty()) {
    return absl::InvalidArgumentError("--recording: expected a directory or a file, received none");
  }
  const auto episodes = ReadRecordings(recording);
  if (!episodes.ok()) {
    return absl::Status(episodes.status().code(),
                        absl::StrCat("--recording: ", episodes.status().message()));
  }
  if (auto status = CheckReplayable(*episodes); !status.ok()) return status;
  const auto client = ConnectToServer();
  if (!client.ok()) return client.status();
  const auto result =
      Replay(*episodes, absl::GetFlag(FLAGS_policy), absl::GetFlag(FLAGS_version), **client);
  if (!result.ok()) return result.status();
  if (absl::GetFlag(FLAGS_json)) std::cout << ToJson(recording, *result).dump(2) << "\n";
  if (const auto& difference = result->difference) {
    return absl::AbortedError(
        absl::StrCat(result->policy, "/", result->version, " differs at episode ",
                     difference->episode, ", step ", difference->step, ", after ",
                     result->decisions, " equal decisions: ", difference->field, ": recorded ",
                     difference->recorded.dump(), ", replayed ", difference->replayed.dump()));
  }
  if (!absl::GetFlag(FLAGS_json)) {
    std::cout << result->policy << "/" << result->version << ": " << result->decisions
              << " decisions of " << result->episodes << " episodes, all equal bit for bit\n";
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
