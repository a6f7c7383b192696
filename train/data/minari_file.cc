#include "train/data/minari_file.h"

#include <cmath>
#include <filesystem>
#include <functional>
#include <limits>
#include <numeric>
#include <system_error>
#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_replace.h"
#include "core/base/file.h"
#include "core/base/json.h"
#include "core/base/json_object.h"
#include "core/base/status.h"
#include "core/environment/environment.h"
#include "train/data/hdf5_file.h"

namespace spikeserve {
namespace {

using Json = nlohmann::ordered_json;

constexpr char kMetadata[] = "/data/metadata.json";
constexpr char kData[] = "/data/main_data.hdf5";
constexpr char kOwn[] = "spikeserve";  // key of this project's metadata

// Returns the specification from which Gymnasium creates the environment, or null if the
// environment is not one of Gymnasium's.
Json EnvironmentSpec(const std::string& id) {
  static constexpr std::pair<const char*, const char*> kClasses[] = {
      {"CartPole-v1", "CartPoleEnv"},
      {"MountainCar-v0", "MountainCarEnv"},
      {"Acrobot-v1", "AcrobotEnv"},
      {"Pendulum-v1", "PendulumEnv"}};
  for (const auto& [own, name] : kClasses) {
    if (id != own) continue;
    return {{"id", id},
            {"entry_point", absl::StrCat("gymnasium.envs.classic_control:", name)},
            {"max_episode_steps", (*MakeEnvironment(id))->max_episode_steps()},
            {"additional_wrappers", Json::array()}};
  }
  return nullptr;
}

// Returns the last component of `directory` if it is a valid dataset id, such as "name-v0".
absl::StatusOr<std::string> DatasetId(const std::string& directory) {
  std::filesystem::path path = directory;
  if (!path.has_filename()) path = path.parent_path();
  const std::string id = path.filename().string();
  const size_t dash = id.rfind("-v");
  int version = 0;
  if (dash != std::string::npos && dash > 0 && absl::SimpleAtoi(id.substr(dash + 2), &version)) {
    return id;
  }
  return absl::InvalidArgumentError(absl::StrCat(
      directory, ": expected a directory named like a Minari dataset, NAME-v0, received ", id));
}

// Returns a Box without bounds: a dataset does not tell the bounds of its environment. Written in
// Python's dialect of JSON, because standard JSON has no infinity.
std::string UnboundedBox(int size) {
  const std::vector<std::string> low(size, "-Infinity"), high(size, "Infinity");
  return absl::StrCat(R"({"type": "Box", "dtype": "float32", "shape": [)", size, R"(], "low": [)",
                      absl::StrJoin(low, ", "), R"(], "high": [)", absl::StrJoin(high, ", "), "]}");
}

std::string SpaceToJson(const ActionSpace& space) {
  if (space.is_discrete()) {
    return Json{{"type", "Discrete"}, {"dtype", "int64"}, {"start", 0}, {"n", space.n}}.dump();
  }
  return Json{{"type", "Box"},
              {"dtype", "float32"},
              {"shape", {space.size()}},
              {"low", space.low},
              {"high", space.high}}
      .dump();
}

Json Metadata(const Dataset& dataset, const std::string& id) {
  int64_t steps = 0;
  for (const Episode& episode : dataset.episodes) steps += episode.steps();
  Json metadata = {{"dataset_id", id},
                   {"total_episodes", dataset.episodes.size()},
                   {"total_steps", steps},
                   {"data_format", "hdf5"},
                   {"minari_version", "0.5.4"},
                   {"observation_space", UnboundedBox(dataset.observation_size)},
                   {"action_space", SpaceToJson(dataset.action_space)},
                   {kOwn, {{"environment", dataset.environment}, {"recipe", dataset.recipe}}}};
  if (const Json spec = EnvironmentSpec(dataset.environment); !spec.is_null()) {
    metadata["env_spec"] = spec.dump();
  }
  return metadata;
}

class Writer {
 public:
  Writer(const Dataset& dataset, Hdf5File* file) : dataset_(dataset), file_(*file) {}

  absl::Status Write() {
    for (size_t i = 0; i < dataset_.episodes.size(); ++i) {
      WriteEpisode(absl::StrCat("episode_", i), static_cast<int64_t>(i), dataset_.episodes[i]);
      if (!status_.ok()) return status_;
    }
    return file_.Close();
  }

 private:
  void WriteEpisode(const std::string& group, int64_t id, const Episode& episode) {
    const int64_t steps = episode.steps();
    status_.Update(file_.CreateGroup(group));
    status_.Update(file_.WriteAttribute(group, "id", id));
    status_.Update(file_.WriteAttribute(group, "total_steps", steps));
    status_.Update(file_.WriteAttribute(group, "seed", static_cast<int64_t>(episode.seed)));
    status_.Update(file_.WriteAttribute(group, "actor", episode.actor));
    if (const auto& served = episode.served) {
      status_.Update(file_.WriteAttribute(group, "policy", served->policy));
      status_.Update(file_.WriteAttribute(group, "policy_version", served->version));
    }
    if (episode.asked_return.has_value()) {
      status_.Update(file_.WriteAttribute(group, "asked_return", *episode.asked_return));
    }
    status_.Update(file_.Write<float>(
        group + "/observations", {steps + 1, dataset_.observation_size}, episode.observations));
    WriteActions(group + "/actions", episode.actions);
    status_.Update(file_.Write<double>(group + "/rewards", {steps, {}}, episode.rewards));
    WriteLast(group + "/terminations", steps, episode.terminated);
    WriteLast(group + "/truncations", steps, episode.truncated);
    WriteInfos(group + "/infos", episode);
  }

  void WriteActions(const std::string& name, const std::vector<Action>& actions) {
    const auto count = static_cast<int64_t>(actions.size());
    if (dataset_.action_space.is_discrete()) {
      std::vector<int64_t> values;
      for (const Action& action : actions) values.push_back(action.discrete);
      status_.Update(file_.Write<int64_t>(name, {count, {}}, values));
      return;
    }
    std::vector<float> values;
    for (const Action& action : actions) {
      values.insert(values.end(), action.continuous.begin(), action.continuous.end());
    }
    status_.Update(file_.Write<float>(name, {count, dataset_.action_space.size()}, values));
  }

  // Writes an array of bools [steps]: false, except for the last one, which is `ended`.
  void WriteLast(const std::string& name, int64_t steps, bool ended) {
    std::vector<uint8_t> values(steps);
    values.back() = ended ? 1 : 0;
    status_.Update(file_.Write<uint8_t>(name, {steps, {}}, values));
  }

  // Infos belong to observations, of which there is one more than actions: the last observation
  // repeats the info of the previous one.
  void WriteInfos(const std::string& group, const Episode& episode) {
    if (episode.labels.empty() && episode.weights.empty() && !episode.served.has_value()) return;
    status_.Update(file_.CreateGroup(group));
    if (!episode.labels.empty()) {
      std::vector<Action> labels = episode.labels;
      labels.push_back(labels.back());
      WriteActions(group + "/label", labels);
    }
    if (!episode.weights.empty()) {
      std::vector<float> weights = episode.weights;
      weights.push_back(weights.back());
      status_.Update(file_.Write<float>(group + "/weight", {episode.steps() + 1, {}}, weights));
    }
    if (episode.served.has_value()) WriteReturnsToGo(group + "/return_to_go", episode);
  }

  // Writes the return-to-go that each decision was conditioned on; after the last action it is G_T
  // = G_{T-1} - r_{T-1}.
  void WriteReturnsToGo(const std::string& name, const Episode& episode) {
    std::vector<float> returns = episode.served->returns_to_go;
    returns.push_back(
        static_cast<float>(static_cast<double>(returns.back()) - episode.rewards.back()));
    status_.Update(file_.Write<float>(name, {episode.steps() + 1, {}}, returns));
  }

  const Dataset& dataset_;
  Hdf5File& file_;
  absl::Status status_;
};

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
  object.Optional(kOwn, &own);
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
    JsonObject ours(kOwn, own);
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
      episode.asked_return = *asked;
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
  const auto text = ReadFile(directory + kMetadata);
  if (!text.ok()) return text.status();
  const auto metadata = ParseJsonObject("metadata", *text);
  if (!metadata.ok()) return metadata.status();
  absl::StatusOr<Description> description = ReadDescription(*metadata);
  if (!description.ok()) return description.status();
  const absl::StatusOr<Hdf5File> file = Hdf5File::Open(directory + kData);
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

absl::Status WriteMinariDataset(const Dataset& dataset, const std::string& directory) {
  const absl::StatusOr<std::string> id = DatasetId(directory);
  if (!id.ok()) return id.status();
  std::error_code error;
  std::filesystem::create_directories(directory + "/data", error);
  if (error) return absl::UnavailableError(absl::StrCat(directory, ": ", error.message()));
  const std::string path = directory + kData, temporary = path + ".tmp";
  absl::StatusOr<Hdf5File> file = Hdf5File::Create(temporary);
  if (!file.ok()) return file.status();
  if (auto status = Writer(dataset, &*file).Write(); !status.ok()) return status;
  std::filesystem::rename(temporary, path, error);
  if (error) return absl::UnavailableError(absl::StrCat(path, ": ", error.message()));
  return WriteFileAtomically(directory + kMetadata, {Metadata(dataset, *id).dump(2)});
}

bool IsMinariDataset(const std::string& path) {
  std::error_code error;
  return std::filesystem::exists(path + kMetadata, error);
}

absl::StatusOr<Dataset> ReadMinariDataset(const std::string& directory) {
  absl::StatusOr<Dataset> dataset = Read(directory);
  return dataset.ok() ? std::move(dataset) : Annotate(dataset.status(), directory);
}

}  // namespace spikeserve
