// Replays recorded episodes with the same or another version of a policy, and compares every
// decision bit for bit.
#include <bit>
#include <cstdint>
#include <iostream>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "absl/types/span.h"
#include "client/spikectl/agent_flags.h"
#include "client/spikectl/commands.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/dataset/dataset.h"
#include "core/dataset/recordings.h"
#include "nlohmann/json.hpp"
#include "spikeserve/client.h"
#include "spikeserve/remote_session.h"

namespace spikeserve {
namespace {

// The first decision that differs from the recording.
struct ReplayDifference {
  int64_t episode = 0;  // of the recorded session
  int64_t step = 0;
  std::string field;  // action, action_probabilities, return_to_go or spikes
  nlohmann::json recorded;
  nlohmann::json replayed;
};

struct ReplayResult {
  std::string policy;
  int64_t version = 0;
  int64_t episodes = 0;                            // replayed completely
  int64_t decisions = 0;                           // number of equal decisions
  std::map<std::string, int64_t> steps_by_source;  // who chose the executed actions of these
  std::optional<ReplayDifference> difference;
};

const ServedEpisode& ServedOf(const Dataset& dataset) { return *dataset.episodes[0].served; }

// Returns whether two values are equal bit for bit; 0 and -0 are different.
bool SameBits(absl::Span<const float> a, absl::Span<const float> b) {
  if (a.size() != b.size()) return false;
  for (size_t i = 0; i < a.size(); ++i) {
    if (std::bit_cast<uint32_t>(a[i]) != std::bit_cast<uint32_t>(b[i])) return false;
  }
  return true;
}

v1::OpenSessionRequest Opening(const ServedEpisode& served, const std::string& policy,
                               int64_t version) {
  v1::OpenSessionRequest request;
  request.set_policy(policy.empty() ? served.policy : policy);
  request.set_version(policy.empty() && version == 0 ? served.version : version);
  request.set_target_return(served.target_return);
  request.set_seed(served.seed);
  if (served.temperature.has_value()) {
    request.set_action_selection(v1::SAMPLE);
    request.set_temperature(static_cast<double>(*served.temperature));
  }
  return request;
}

// Returns the action that was executed at `step`, or nothing if it is the answered one.
std::optional<v1::Action> Executed(const Dataset& dataset, int step) {
  const Episode& episode = dataset.episodes[0];
  const Action& executed = episode.actions[static_cast<size_t>(step)];
  if (executed == episode.answered(step)) return std::nullopt;
  v1::Action action;
  if (dataset.action_space.is_discrete()) {
    action.set_discrete(executed.discrete);
  } else {
    action.mutable_continuous()->mutable_values()->Add(executed.continuous.begin(),
                                                       executed.continuous.end());
  }
  return action;
}

// Compares one decision with what was recorded at `step`.
class DecisionCheck {
 public:
  DecisionCheck(const Dataset& dataset, int step)
      : dataset_(dataset),
        episode_(dataset.episodes[0]),
        served_(*episode_.served),
        step_(static_cast<size_t>(step)) {}

  std::optional<ReplayDifference> Find(const v1::ActResponse& response) {
    CompareAction(response.action());
    const size_t n = served_.probabilities.size() / episode_.actions.size();
    CompareFloats("action_probabilities",
                  absl::MakeConstSpan(served_.probabilities).subspan(step_ * n, n),
                  response.action_probabilities());
    const auto return_to_go = static_cast<float>(response.return_to_go());  // computed as float32
    CompareFloats("return_to_go", absl::MakeConstSpan(served_.returns_to_go).subspan(step_, 1),
                  absl::MakeConstSpan(&return_to_go, 1));
    Compare("spikes", served_.spikes[step_], response.stats().spikes());
    return std::move(difference_);
  }

 private:
  void CompareAction(const v1::Action& action) {
    const Action& recorded = episode_.answered(static_cast<int>(step_));
    if (dataset_.action_space.is_discrete()) {
      Compare("action", int64_t{recorded.discrete}, action.discrete());
    } else {
      CompareFloats("action", recorded.continuous, action.continuous().values());
    }
  }

  void CompareFloats(const char* field, absl::Span<const float> recorded,
                     absl::Span<const float> replayed) {
    if (SameBits(recorded, replayed)) return;
    Differ(field, nlohmann::json(std::vector<float>(recorded.begin(), recorded.end())),
           nlohmann::json(std::vector<float>(replayed.begin(), replayed.end())));
  }

  template <typename T>
  void Compare(const char* field, T recorded, T replayed) {
    if (recorded != replayed) Differ(field, recorded, replayed);
  }

  // Records a difference. Only the first one of a decision is kept.
  void Differ(const char* field, nlohmann::json recorded, nlohmann::json replayed) {
    if (difference_.has_value()) return;
    difference_ = {.episode = served_.episode,
                   .step = static_cast<int64_t>(step_),
                   .field = field,
                   .recorded = std::move(recorded),
                   .replayed = std::move(replayed)};
  }

  const Dataset& dataset_;
  const Episode& episode_;
  const ServedEpisode& served_;
  const size_t step_;
  std::optional<ReplayDifference> difference_;
};

// Replays one episode up to the first difference.
absl::Status ReplayEpisode(const Dataset& dataset, RemoteSession& session, ReplayResult* result) {
  const Episode& episode = dataset.episodes[0];
  const auto size = static_cast<size_t>(dataset.observation_size);
  const std::vector<double>& rewards = episode.received_rewards();
  for (int step = 0; step < episode.steps(); ++step) {
    const auto observation =
        absl::MakeConstSpan(episode.observations).subspan(static_cast<size_t>(step) * size, size);
    ASSIGN_OR_RETURN(const auto response, step == 0 ? session.Act(observation, 0.0)
                                                    : session.Act(observation, rewards[step - 1],
                                                                  Executed(dataset, step - 1)));
    result->difference = DecisionCheck(dataset, step).Find(response);
    if (result->difference.has_value()) return absl::OkStatus();
    ++result->decisions;
    ++result->steps_by_source[ToString(episode.source(step))];
  }
  ++result->episodes;
  return absl::OkStatus();
}

absl::Status ReplayEpisodes(const std::vector<Dataset>& recording, RemoteSession& session,
                            ReplayResult* result) {
  for (size_t i = 0; i < recording.size(); ++i) {
    if (i > 0) {
      const Episode& before = recording[i - 1].episodes[0];
      RETURN_IF_ERROR(
          (session.EndEpisode({.reward = before.received_rewards().back(),
                               .terminated = before.terminated,
                               .truncated = before.truncated,
                               .target_return = ServedOf(recording[i]).target_return,
                               .executed_action = Executed(recording[i - 1], before.steps() - 1)}))
              .status());
    }
    absl::Status status = ReplayEpisode(recording[i], session, result);
    if (!status.ok() || result->difference.has_value()) return status;
  }
  return absl::OkStatus();
}

// Returns INVALID_ARGUMENT unless `recording` can be replayed. It must hold the served episodes of
// one session without learning, one dataset per episode, in order. If actions were sampled, it must
// start with the first episode of the session and have no gap, because the random draws of an
// episode depend on the episodes before it.
absl::Status CheckReplayable(const std::vector<Dataset>& recording) {
  for (size_t i = 0; i < recording.size(); ++i) {
    const std::vector<Episode>& episodes = recording[i].episodes;
    if (episodes.size() != 1 || !episodes[0].served.has_value()) {
      return InvalidArgument("recording", "episodes that a server recorded",
                             "a dataset of another kind");
    }
    const ServedEpisode& served = *episodes[0].served;
    const ServedEpisode& first = ServedOf(recording[0]);
    if (served.learning) {
      return InvalidArgument("recording", "a session with the policy's head", "one that learned");
    }
    if (served.policy != first.policy || served.version != first.version ||
        served.seed != first.seed ||
        (i > 0 && served.episode <= ServedOf(recording[i - 1]).episode)) {
      return InvalidArgument("recording", "one session", "several; name the directory of one");
    }
    if (served.temperature.has_value() && served.episode != static_cast<int64_t>(i)) {
      return InvalidArgument(
          "recording", absl::StrCat("episode ", i),
          absl::StrCat("episode ", served.episode,
                       "; a session that draws its actions is replayed from its first episode"));
    }
  }
  return absl::OkStatus();
}

// Replays `recording` in a new session until a decision differs. If `policy` is empty, uses the
// policy of the recording, and its version if `version` is 0. Otherwise a `version` of 0 is the
// default version of `policy`. REQUIRES: CheckReplayable returns OK.
absl::StatusOr<ReplayResult> Replay(const std::vector<Dataset>& recording,
                                    const std::string& policy, int64_t version, Client& client) {
  SPIKESERVE_DCHECK(CheckReplayable(recording).ok());
  ASSIGN_OR_RETURN(auto session,
                   RemoteSession::Open(&client, Opening(ServedOf(recording[0]), policy, version)));
  ReplayResult result;
  result.policy = session.opening().policy();
  result.version = session.opening().version();
  absl::Status status = ReplayEpisodes(recording, session, &result);
  status.Update(session.Close());
  if (!status.ok()) return status;
  return result;
}

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
