// Defines recorded episodes, which offline training learns from and which can be replayed.
//
// Plain values and free functions; thread-safe on distinct data.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/action/action_space.h"
#include "core/action/step_source.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// What a server adds to the recording of an episode that it decided: the session, and the values
// beside each action.
struct ServedEpisode {
  std::string policy;
  int64_t version = 0;
  int64_t episode = 0;               // index within the session, from 0
  double target_return = 0.0;        // G_0
  uint64_t seed = 0;                 // of the session
  std::optional<float> temperature;  // of sampled actions; absent: greedy
  // Whether the session learned, or started from a head that differs from the policy's.
  bool learning = false;
  std::map<std::string, std::string> labels;
  std::vector<Action> answered_actions;  // [steps]; empty if every action was executed as answered
  // [steps]: who chose each executed action; empty: the policy if it is the answered one, otherwise
  // not known.
  std::vector<StepSource> sources = {};
  std::vector<float> returns_to_go;  // [steps]: what each decision was conditioned on
  std::vector<float> probabilities;  // [steps, n]; Discrete spaces only
  std::vector<uint64_t> spikes;      // [steps]
  // Of sampled actions of a Box, [steps, action size] each, and empty otherwise: the answered
  // action is tanh(logits + temperature * noise), mapped to the bounds.
  std::vector<float> logits = {};
  std::vector<float> noise = {};   // standard normal
  std::string policy_sha256 = {};  // of the policy's file, in hexadecimal; empty: unknown
  std::string session = {};        // id; empty: unknown
  std::string tenant = {};         // owner of the session; empty if the server has no tenants
  // Of an episode that was judged after its end (amendments.h):
  std::vector<double> received_rewards = {};  // [steps]; empty if `rewards` are as received
  std::optional<bool> success = std::nullopt;
  std::string verdict = {};  // the label that the last author gave; empty: none
};

// One episode of `steps` actions.
struct Episode {
  std::string actor;  // source: "expert", "disturbed", "student", "random" or "served"
  uint64_t seed = 0;  // argument of Environment::Reset
  // [steps + 1, obs], in environment units. The last observation is NaN if it is unknown.
  std::vector<float> observations;
  std::vector<Action> actions;      // [steps], as executed
  std::vector<Action> labels = {};  // [steps]: actions to imitate; empty if they are `actions`
  std::vector<float> weights = {};  // [steps]: loss weights of the labels; empty if all are 1
  std::vector<double> rewards;      // [steps]
  bool terminated = false;
  bool truncated = false;
  // The return that the actor was asked to reach, or nothing. If set, the returns-to-go start from
  // it; otherwise they start from the return of the episode.
  std::optional<double> target_return = std::nullopt;
  std::optional<ServedEpisode> served = std::nullopt;

  // Returns the action to imitate at `step`.
  const Action& label(int step) const { return labels.empty() ? actions[step] : labels[step]; }
  // Returns the weight of that action in the loss.
  float weight(int step) const { return weights.empty() ? 1.0f : weights[step]; }
  // Returns the action that the server answered at `step`. REQUIRES: a served episode.
  const Action& answered(int step) const {
    return served->answered_actions.empty() ? actions[step] : served->answered_actions[step];
  }
  // Returns the rewards [steps] that the decisions were conditioned on. REQUIRES: a served episode.
  const std::vector<double>& received_rewards() const {
    return served->received_rewards.empty() ? rewards : served->received_rewards;
  }
  // Returns who chose the action that was executed at `step`. REQUIRES: a served episode.
  StepSource source(int step) const {
    if (!served->sources.empty()) return served->sources[step];
    return {.kind = actions[step] == answered(step) ? SourceKind::kPolicy : SourceKind::kUnknown};
  }
  int steps() const { return static_cast<int>(actions.size()); }
};

// Episodes of one environment.
struct Dataset {
  std::string environment;  // Gymnasium's id
  int observation_size = 0;
  ActionSpace action_space;
  nlohmann::json recipe = nlohmann::json::object();  // how the episodes were recorded
  std::vector<Episode> episodes;
};

// The largest absolute value of an observation, a reward, a weight and a return that is asked for:
// its square is still a number of float.
inline constexpr double kLargestDataNumber = 1e18;

// Returns INVALID_ARGUMENT, which names the array, the step and the element, if the length of an
// array of `episode` does not match the number of steps and the dataset's observation size, if a
// number is not finite or too large, if a weight is negative, or if an action is outside the
// dataset's action space. The last observation may be NaN as a whole.
absl::Status CheckEpisode(const Dataset& dataset, const Episode& episode);

// Rounds actions and labels of a Box to its bounds where they are outside by less than a millionth
// of the range, as arithmetic in double leaves them. Then returns CheckEpisode(). For episodes from
// a file.
absl::Status AcceptEpisode(const Dataset& dataset, Episode* episode);

// Returns one dataset with the episodes of all `datasets`, in order. INVALID_ARGUMENT if their
// environments or spaces differ. REQUIRES: at least one dataset.
absl::StatusOr<Dataset> Concatenate(std::vector<Dataset> datasets);

// Writes `dataset` as a CBOR file, one object with the fields above. Error messages start with the
// path.
absl::Status WriteDataset(const Dataset& dataset, const std::string& path);
// Reads a file that WriteDataset wrote, with its amendments (amendments.h). NOT_FOUND if it cannot
// be read, INVALID_ARGUMENT if it is not a valid dataset; messages start with the path.
absl::StatusOr<Dataset> ReadDataset(const std::string& path);

}  // namespace spikeserve
