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

// A space as described by Minari's serialisation of Gymnasium spaces.
struct SpaceDescription {
  std::string type;
  std::vector<int> shape;  // Box
  nlohmann::json low;      // Box: a number, or a nested list of numbers
  nlohmann::json high;
  int n = 0;  // Discrete
  int start = 0;

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
  JsonObject object(field, *parsed);
  object.AllowOtherKeys();
  object.Required("type", &space.type);
  if (space.type == "Box") {
    object.Required("shape", &space.shape);
    object.Required("low", &space.low);
    object.Required("high", &space.high);
  } else if (space.type == "Discrete") {
    object.Required("n", &space.n);
    object.Optional("start", &space.start);
  }
  if (auto status = object.Finish(); !status.ok()) return status;
  return space;
}

absl::StatusOr<ActionSpace> ToActionSpace(const SpaceDescription& description) {
  ActionSpace space;
  if (description.type == "Discrete") {
    if (description.start != 0) {
      return absl::InvalidArgumentError(absl::StrCat(
          "action_space: expected Discrete from 0, received one from ", description.start));
    }
    space = ActionSpace::Discrete(description.n);
  } else if (description.type == "Box") {
    auto low = description.Bounds("action_space.low", description.low);
    if (!low.ok()) return low.status();
    auto high = description.Bounds("action_space.high", description.high);
    if (!high.ok()) return high.status();
    space = ActionSpace::Box(*std::move(low), *std::move(high));
  } else {
    return absl::InvalidArgumentError(
        absl::StrCat("action_space: expected Discrete or Box, received ", description.type));
  }
  if (auto status = space.Validate(); !status.ok()) return Annotate(status, "action_space");
  return space;
}

// The contents of a dataset's metadata.json.
struct Description {
  Dataset dataset;  // without its episodes
  int episodes = 0;
  bool ours = false;  // whether this project wrote the dataset
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
    return absl::InvalidArgumentError(
        absl::StrCat("observation_space: expected Box, received ", observations->type));
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
  description.ours = !own.is_null();
  if (description.ours) {
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
  // `ours` tells whether this project wrote the file.
  Reader(const Hdf5File& file, bool ours, Dataset* dataset)
      : file_(file), ours_(ours), dataset_(*dataset) {}

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
    // The infos of foreign datasets have no known meaning.
    if (ours_) {
      if (auto status = ReadInfos(group + "/infos", &episode); !status.ok()) return status;
    }
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
    if (dataset_.action_space.is_discrete()) {
      const auto values = file_.Read<int64_t>(name);
      if (!values.ok()) return values.status();
      for (const int64_t value : values->values) {
        actions->push_back({.discrete = static_cast<int>(value), .continuous = {}});
      }
      return absl::OkStatus();
    }
    const auto values = file_.Read<float>(name);
    if (!values.ok()) return values.status();
    const auto columns = static_cast<size_t>(values->shape.columns.value_or(1));
    for (size_t at = 0; at + columns <= values->values.size(); at += columns) {
      const auto begin = values->values.begin() + static_cast<int64_t>(at);
      actions->push_back(
          {.discrete = 0, .continuous = {begin, begin + static_cast<int64_t>(columns)}});
    }
    return absl::OkStatus();
  }

  absl::Status ReadInfos(const std::string& group, Episode* episode) {
    if (file_.Exists(group + "/label")) {
      if (auto status = ReadActions(group + "/label", &episode->labels); !status.ok()) {
        return status;
      }
      episode->labels.resize(episode->actions.size());
    }
    if (file_.Exists(group + "/weight")) {
      const auto weights = file_.Read<float>(group + "/weight");
      if (!weights.ok()) return weights.status();
      episode->weights = weights->values;
      episode->weights.resize(episode->actions.size());
    }
    return absl::OkStatus();
  }

  const Hdf5File& file_;
  const bool ours_;
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
  Reader reader(*file, description->ours, &dataset);
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
