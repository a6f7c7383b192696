// Recorded episodes: what offline training learns from, and what can be replayed.
//
// Plain values and free functions; safe to call from many threads on distinct data.
#ifndef CORE_DATASET_DATASET_H_
#define CORE_DATASET_DATASET_H_

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/action/action_space.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// What a server knows of an episode that it decided: whose decisions they were, and what they said
// beside the actions.
struct ServedEpisode {
  std::string policy;
  int64_t version = 0;
  int64_t episode = 0;               // of its session, counts from 0
  double target_return = 0.0;        // G_0
  uint64_t seed = 0;                 // of its session
  std::optional<float> temperature;  // of the draws; absent: greedy
  bool learning = false;             // its head was not the policy's: it learned, or had
  std::map<std::string, std::string> labels;
  std::vector<float> returns_to_go;  // [steps], what each decision was conditioned on
  std::vector<float> probabilities;  // [steps, n]; Discrete spaces only
  std::vector<uint64_t> spikes;      // [steps]
};

struct Episode {
  std::string actor;  // who acted: "expert", "disturbed", "student", "random" or "served"
  uint64_t seed = 0;  // of Environment::Reset
  // [steps + 1, obs], environment units; the last one not a number where nobody told it.
  std::vector<float> observations;
  std::vector<Action> actions;      // [steps], as executed
  std::vector<Action> labels = {};  // [steps], what to imitate; empty where that is `actions`
  std::vector<float> weights = {};  // [steps], of the labels in the loss; empty where all are 1
  std::vector<double> rewards;      // [steps]
  bool terminated = false;
  bool truncated = false;
  // What the actor was asked for, where it was; returns-to-go count down from it then, else from
  // what the episode returned.
  std::optional<double> asked_return = std::nullopt;
  std::optional<ServedEpisode> served = std::nullopt;

  // What to imitate at a step.
  const Action& label(int step) const { return labels.empty() ? actions[step] : labels[step]; }
  float weight(int step) const { return weights.empty() ? 1.0f : weights[step]; }
  int steps() const { return static_cast<int>(actions.size()); }
};

struct Dataset {
  std::string environment;  // Gymnasium's id
  int observation_size = 0;
  ActionSpace action_space;
  nlohmann::json recipe = nlohmann::json::object();  // how it was recorded
  std::vector<Episode> episodes;
};

// INVALID_ARGUMENT if an array of the episode is not of the length that the others and the
// dataset's observations ask for, or an action is not of its action space.
absl::Status CheckEpisode(const Dataset& dataset, const Episode& episode);

// The episodes of all, which are of the same environment, in their order. REQUIRES: at least one.
absl::StatusOr<Dataset> Concatenate(std::vector<Dataset> datasets);

// A dataset file is CBOR, one object with the fields above. Errors start with the path.
absl::Status WriteDataset(const Dataset& dataset, const std::string& path);
absl::StatusOr<Dataset> ReadDataset(const std::string& path);

}  // namespace spikeserve

#endif  // CORE_DATASET_DATASET_H_
