// Recorded episodes: what offline training learns from.
//
// Plain values and free functions; safe to call from many threads on distinct data.
#ifndef TRAIN_DATASET_H_
#define TRAIN_DATASET_H_

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/types/optional.h"
#include "core/model/action_space.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

struct Episode {
  std::string actor;                // who acted: "expert", "disturbed", "student" or "random"
  uint64_t seed = 0;                // of Environment::Reset
  std::vector<float> observations;  // [steps + 1, obs], environment units
  std::vector<Action> actions;      // [steps], as executed
  std::vector<Action> labels = {};  // [steps], what to imitate; empty where that is `actions`
  std::vector<float> weights = {};  // [steps], of the labels in the loss; empty where all are 1
  std::vector<double> rewards;      // [steps]
  bool terminated = false;
  bool truncated = false;
  // What the actor was asked for, where it was; returns-to-go count down from it then, else from
  // what the episode returned.
  absl::optional<double> asked_return = absl::nullopt;

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

// [steps]: G_t = r_t + r_{t+1} + ... to the end of the episode; or, where a return was asked for,
// what is left of that.
std::vector<float> ReturnsToGo(const Episode& episode);

// Mean and deviation of every observation entry over all steps, both [obs].
struct Moments {
  std::vector<float> mean;
  std::vector<float> std;  // > 0
};
Moments ObservationMoments(const Dataset& dataset);

// The episodes of all, which are of the same environment, in their order. REQUIRES: at least one.
absl::StatusOr<Dataset> Concatenate(std::vector<Dataset> datasets);

// A dataset file is CBOR, one object with the fields above. Errors start with the path.
absl::Status WriteDataset(const Dataset& dataset, const std::string& path);
absl::StatusOr<Dataset> ReadDataset(const std::string& path);

}  // namespace spikeserve

#endif  // TRAIN_DATASET_H_
