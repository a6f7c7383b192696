#include "train/data/minari_reader.h"

#include <cmath>
#include <filesystem>
#include <functional>
#include <limits>
#include <numeric>
#include <system_error>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_replace.h"
#include "core/base/file.h"
#include "core/base/json.h"
#include "core/base/json_object.h"
#include "core/base/status.h"
#include "train/data/hdf5_file.h"
#include "train/data/minari_layout.h"

namespace spikeserve {
namespace {

constexpr int64_t kLargestJointSpace = 4096;  // the outputs of an action head

// Parses Python's dialect of JSON. Infinities, which standard JSON lacks, become +-1e300, which is
// beyond the range of float.
absl::StatusOr<nlohmann::json> ParsePython(absl::string_view field, absl::string_view text) {
  return ParseJsonObject(field, absl::StrReplaceAll(text, {{"Infinity", "1e300"}}));
}

float ToFloat(double x) {
  const bool finite = std::abs(x) <= static_cast<double>(std::numeric_limits<float>::max());
  return finite ? static_cast<float>(x) : std::copysign(std::numeric_limits<float>::infinity(), x);
}

// Appends `json`, a number or a nested list of numbers, to `bounds`.
absl::Status AppendBounds(absl::string_view field, const nlohmann::json& json,
                          std::vector<float>* bounds) {
  if (json.is_array()) {
    for (const nlohmann::json& item : json) {
      if (auto status = AppendBounds(field, item, bounds); !status.ok()) return status;
    }
    return absl::OkStatus();
  }
  double bound = 0.0;
  auto status = ReadJson(field, json, &bound);
  bounds->push_back(ToFloat(bound));
  return status;
}

// Appends `json`, an integer or a nested list of integers, to `values`.
absl::Status AppendIntegers(absl::string_view field, const nlohmann::json& json,
                            std::vector<int64_t>* values) {
  if (json.is_array()) {
    for (const nlohmann::json& item : json) {
      if (auto status = AppendIntegers(field, item, values); !status.ok()) return status;
    }
    return absl::OkStatus();
  }
  int64_t value = 0;
  auto status = ReadJson(field, json, &value);
  values->push_back(value);
  return status;
}

// A space as described by Minari's serialisation of Gymnasium spaces.
struct SpaceDescription {
  std::string type;
  std::vector<int> shape;  // Box
  nlohmann::json low;      // Box: a number, or a nested list of numbers
  nlohmann::json high;
  // Discrete and MultiDiscrete: the number of indices of each element, and its first index.
  std::vector<int64_t> counts;
  std::vector<int64_t> starts;

  int size() const {
    return std::accumulate(shape.begin(), shape.end(), 1, std::multiplies<int>());
  }

  // Returns one bound per entry of a Box; repeats a single number for all entries.
  absl::StatusOr<std::vector<float>> Bounds(absl::string_view field,
                                            const nlohmann::json& json) const {
    std::vector<float> bounds;
    if (auto status = AppendBounds(field, json, &bounds); !status.ok()) return status;
    if (bounds.size() == 1) bounds.resize(size(), bounds[0]);
    return bounds;
  }
};

absl::StatusOr<SpaceDescription> ParseSpace(absl::string_view field, absl::string_view text) {
  const auto parsed = ParsePython(field, text);
  if (!parsed.ok()) return parsed.status();
  SpaceDescription space;
  nlohmann::json counts, starts;
  JsonObject object(field, *parsed);
  object.AllowOtherKeys();
  object.Required("type", &space.type);
  if (space.type == "Box") {
    object.Required("shape", &space.shape);
    object.Required("low", &space.low);
    object.Required("high", &space.high);
  } else if (space.type == "Discrete") {
    object.Required("n", &counts);
    object.Optional("start", &starts);
  } else if (space.type == "MultiDiscrete") {
    object.Required("nvec", &counts);
    object.Optional("start", &starts);
  }
  if (auto status = object.Finish(); !status.ok()) return status;
  if (counts.is_null()) return space;
  if (auto status = AppendIntegers(field, counts, &space.counts); !status.ok()) return status;
  if (!starts.is_null()) {
    if (auto status = AppendIntegers(field, starts, &space.starts); !status.ok()) return status;
  }
  space.starts.resize(space.counts.size());
  return space;
}

// Returns the Discrete space of all combinations of the elements.
absl::StatusOr<ActionSpace> JointSpace(const SpaceDescription& description) {
  int64_t joint = 1;
  for (const int64_t count : description.counts) {
    if (count < 1 || count > kLargestJointSpace) {
      return absl::InvalidArgumentError(absl::StrCat(
          "action_space: expected 1 to ", kLargestJointSpace, " indices, received ", count));
    }
    joint *= count;
    if (joint > kLargestJointSpace) {
      return absl::InvalidArgumentError(absl::StrCat(
          "action_space: expected at most ", kLargestJointSpace, " combinations, received more"));
    }
  }
  return ActionSpace::Discrete(static_cast<int>(joint));
}

absl::StatusOr<ActionSpace> ToActionSpace(const SpaceDescription& description) {
  ActionSpace space;
  if (!description.counts.empty()) {
    auto joint = JointSpace(description);
    if (!joint.ok()) return joint;
    space = *std::move(joint);
  } else if (description.type == "Box") {
    auto low = description.Bounds("action_space.low", description.low);
    if (!low.ok()) return low.status();
    auto high = description.Bounds("action_space.high", description.high);
    if (!high.ok()) return high.status();
    space = ActionSpace::Box(*std::move(low), *std::move(high));
  } else {
    return absl::InvalidArgumentError(absl::StrCat(
        "action_space: expected Discrete, MultiDiscrete or Box, received ", description.type));
  }
  if (auto status = space.Validate(); !status.ok()) return Annotate(status, "action_space");
  return space;
}

// The contents of a dataset's metadata.json.
struct Description {
  Dataset dataset;  // without its episodes
  int episodes = 0;
  SpaceDescription actions;
};

absl::StatusOr<Description> ReadDescription(const nlohmann::json& metadata) {
  Description description;
  std::string id, observation_space, action_space;
  nlohmann::json own, environment;
  JsonObject object("metadata", metadata);
  object.AllowOtherKeys();
  object.Required("dataset_id", &id);
  object.Required("observation_space", &observation_space);
  object.Required("action_space", &action_space);
  object.Required("total_episodes", &description.episodes, 0);
  object.Optional("env_spec", &environment);
  object.Optional(kMinariExtension, &own);
  if (auto status = object.Finish(); !status.ok()) return status;
  const auto observations = ParseSpace("observation_space", observation_space);
  if (!observations.ok()) return observations.status();
  if (observations->type != "Box") {
    return absl::InvalidArgumentError(absl::StrCat("observation_space: expected Box, received ",
                                                   observations->type,
                                                   "; record with Gymnasium's FlattenObservation"));
  }
  const auto actions = ParseSpace("action_space", action_space);
  if (!actions.ok()) return actions.status();
  auto space = ToActionSpace(*actions);
  if (!space.ok()) return space.status();
  Dataset& dataset = description.dataset;
  dataset = {.environment = id,
             .observation_size = observations->size(),
             .action_space = *std::move(space),
             .recipe = {{"minari", id}},
             .episodes = {}};
  description.actions = *actions;
  if (!own.is_null()) {
    JsonObject ours(kMinariExtension, own);
    ours.Required("environment", &dataset.environment);
    ours.Required("recipe", &dataset.recipe);
    if (auto status = ours.Finish(); !status.ok()) return status;
  } else if (environment.is_string()) {
    const auto spec = ParsePython("env_spec", environment.get_ref<const std::string&>());
    if (!spec.ok()) return spec.status();
    JsonObject of_gymnasium("env_spec", *spec);
    of_gymnasium.AllowOtherKeys();
    of_gymnasium.Required("id", &dataset.environment);
    if (auto status = of_gymnasium.Finish(); !status.ok()) return status;
  }
  return description;
}

class Reader {
 public:
  Reader(const Hdf5File& file, const SpaceDescription& actions, Dataset* dataset)
      : file_(file), space_(actions), dataset_(*dataset) {}

  absl::Status Read(int episodes) {
    for (int i = 0; i < episodes; ++i) {
      if (auto status = ReadEpisode(absl::StrCat("episode_", i)); !status.ok()) return status;
    }
    return absl::OkStatus();
  }

 private:
  absl::Status ReadEpisode(const std::string& group) {
    Episode episode;
    const auto observations = file_.Read<float>(group + "/observations");
    if (!observations.ok()) return observations.status();
    episode.observations = observations->values;
    const auto rewards = file_.Read<double>(group + "/rewards");
    if (!rewards.ok()) return rewards.status();
    episode.rewards = rewards->values;
    if (auto status = ReadActions(group + "/actions", &episode.actions); !status.ok()) {
      return status;
    }
    for (const auto& [name, ended] : {std::pair{"/terminations", &episode.terminated},
                                      std::pair{"/truncations", &episode.truncated}}) {
      const auto values = file_.ReadBools(group + name);
      if (!values.ok()) return values.status();
      *ended = !values->empty() && values->back();
    }
    if (auto status = ReadInfos(group + "/infos", &episode); !status.ok()) return status;
    episode.actor = file_.ReadString(group, "actor").value_or("unknown");
    episode.seed = static_cast<uint64_t>(file_.ReadInteger(group, "seed").value_or(0));
    if (const auto asked = file_.ReadDouble(group, "asked_return"); asked.ok()) {
      episode.target_return = *asked;
    }
    if (auto status = CheckEpisode(dataset_, episode); !status.ok()) {
      return Annotate(status, group);
    }
    dataset_.episodes.push_back(std::move(episode));
    return absl::OkStatus();
  }

  absl::Status ReadActions(const std::string& name, std::vector<Action>* actions) {
    if (dataset_.action_space.is_discrete()) return ReadIndices(name, actions);
    const auto values = file_.Read<float>(name);
    if (!values.ok()) return values.status();
    const int64_t columns = values->shape.columns.value_or(1);
    if (auto status = CheckColumns(name, dataset_.action_space.size(), columns); !status.ok()) {
      return status;
    }
    for (int64_t row = 0; row < values->shape.rows; ++row) {
      const auto begin = values->values.begin() + row * columns;
      actions->push_back({.discrete = 0, .continuous = {begin, begin + columns}});
    }
    return absl::OkStatus();
  }

  // Reads one index an action, or one for each element of a MultiDiscrete, which become the index
  // of their combination: the last element changes fastest.
  absl::Status ReadIndices(const std::string& name, std::vector<Action>* actions) {
    const auto values = file_.Read<int64_t>(name);
    if (!values.ok()) return values.status();
    const auto elements = static_cast<int64_t>(space_.counts.size());
    if (auto status = CheckColumns(name, elements, values->shape.columns.value_or(1));
        !status.ok()) {
      return status;
    }
    for (int64_t row = 0; row < values->shape.rows; ++row) {
      int64_t joint = 0;
      for (int64_t i = 0; i < elements; ++i) {
        const int64_t index = values->values[row * elements + i] - space_.starts[i];
        if (index < 0 || index >= space_.counts[i]) {
          return absl::InvalidArgumentError(
              absl::StrCat(name, ": expected ", space_.starts[i], " to ",
                           space_.starts[i] + space_.counts[i] - 1, ", received ",
                           index + space_.starts[i], " at step ", row));
        }
        joint = joint * space_.counts[i] + index;
      }
      actions->push_back({.discrete = static_cast<int>(joint), .continuous = {}});
    }
    return absl::OkStatus();
  }

  static absl::Status CheckColumns(const std::string& name, int64_t expected, int64_t received) {
    if (expected == received) return absl::OkStatus();
    return absl::InvalidArgumentError(
        absl::StrCat(name, ": expected ", expected, " values an action, received ", received));
  }

  // Infos belong to observations, so there may be one more than actions.
  absl::Status ReadInfos(const std::string& group, Episode* episode) {
    const size_t steps = episode->actions.size();
    if (file_.Exists(group + "/label")) {
      if (auto status = ReadActions(group + "/label", &episode->labels); !status.ok()) {
        return status;
      }
      if (auto status = TrimInfos(group + "/label", steps, &episode->labels); !status.ok()) {
        return status;
      }
    }
    if (!file_.Exists(group + "/weight")) return absl::OkStatus();
    const auto weights = file_.Read<float>(group + "/weight");
    if (!weights.ok()) return weights.status();
    episode->weights = weights->values;
    return TrimInfos(group + "/weight", steps, &episode->weights);
  }

  template <typename T>
  static absl::Status TrimInfos(const std::string& name, size_t steps, std::vector<T>* infos) {
    if (infos->size() != steps && infos->size() != steps + 1) {
      return absl::InvalidArgumentError(absl::StrCat(name, ": expected ", steps, " or ", steps + 1,
                                                     " rows, received ", infos->size()));
    }
    infos->resize(steps);
    return absl::OkStatus();
  }

  const Hdf5File& file_;
  const SpaceDescription& space_;
  Dataset& dataset_;
};

absl::StatusOr<Dataset> Read(const std::string& directory) {
  const auto text = ReadFile(directory + kMinariMetadata);
  if (!text.ok()) return text.status();
  const auto metadata = ParseJsonObject("metadata", *text);
  if (!metadata.ok()) return metadata.status();
  absl::StatusOr<Description> description = ReadDescription(*metadata);
  if (!description.ok()) return description.status();
  const absl::StatusOr<Hdf5File> file = Hdf5File::Open(directory + kMinariData);
  if (!file.ok()) return file.status();
  Dataset& dataset = description->dataset;
  Reader reader(*file, description->actions, &dataset);
  if (auto status = reader.Read(description->episodes); !status.ok()) return status;
  if (dataset.episodes.empty()) {
    return absl::InvalidArgumentError("total_episodes: expected at least 1, received 0");
  }
  return std::move(dataset);
}

}  // namespace

bool IsMinariDataset(const std::string& path) {
  std::error_code error;
  return std::filesystem::exists(path + kMinariMetadata, error);
}

absl::StatusOr<Dataset> ReadMinariDataset(const std::string& directory) {
  absl::StatusOr<Dataset> dataset = Read(directory);
  return dataset.ok() ? std::move(dataset) : Annotate(dataset.status(), directory);
}

}  // namespace spikeserve
