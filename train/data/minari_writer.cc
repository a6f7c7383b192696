#include "train/data/minari_writer.h"

#include <filesystem>
#include <system_error>
#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/environment/environment.h"
#include "nlohmann/json.hpp"
#include "train/data/hdf5_file.h"
#include "train/data/minari_layout.h"

namespace spikeserve {
namespace {

using Json = nlohmann::ordered_json;

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
  Json metadata = {
      {"dataset_id", id},
      {"total_episodes", dataset.episodes.size()},
      {"total_steps", steps},
      {"data_format", "hdf5"},
      {"minari_version", "0.5.4"},
      {"observation_space", UnboundedBox(dataset.observation_size)},
      {"action_space", SpaceToJson(dataset.action_space)},
      {kMinariExtension, {{"environment", dataset.environment}, {"recipe", dataset.recipe}}}};
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
      if (served->success.has_value()) {
        status_.Update(
            file_.WriteAttribute(group, "success", static_cast<int64_t>(*served->success)));
      }
      if (!served->verdict.empty()) {
        status_.Update(file_.WriteAttribute(group, "verdict", served->verdict));
      }
    }
    if (episode.target_return.has_value()) {
      status_.Update(file_.WriteAttribute(group, "asked_return", *episode.target_return));
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
    if (!episode.served.has_value()) return;
    WriteReturnsToGo(group + "/return_to_go", episode);
    WriteSources(group + "/source", episode);
  }

  // Writes who chose each executed action, by SourceKind.
  void WriteSources(const std::string& name, const Episode& episode) {
    std::vector<int64_t> sources;
    for (int step = 0; step < episode.steps(); ++step) {
      sources.push_back(static_cast<int64_t>(episode.source(step).kind));
    }
    sources.push_back(sources.back());
    status_.Update(file_.Write<int64_t>(name, {episode.steps() + 1, {}}, sources));
  }

  // Writes the return-to-go that each decision was conditioned on; after the last action it is G_T
  // = G_{T-1} - r_{T-1}.
  void WriteReturnsToGo(const std::string& name, const Episode& episode) {
    std::vector<float> returns = episode.served->returns_to_go;
    returns.push_back(static_cast<float>(static_cast<double>(returns.back()) -
                                         episode.received_rewards().back()));
    status_.Update(file_.Write<float>(name, {episode.steps() + 1, {}}, returns));
  }

  const Dataset& dataset_;
  Hdf5File& file_;
  absl::Status status_;
};

}  // namespace

absl::StatusOr<std::string> MinariId(const std::string& directory) {
  std::filesystem::path path = directory;
  if (!path.has_filename()) path = path.parent_path();
  const std::string id = path.filename().string();
  const size_t dash = id.rfind("-v");
  int version = 0;
  if (dash != std::string::npos && dash > 0 && absl::SimpleAtoi(id.substr(dash + 2), &version)) {
    return id;
  }
  return InvalidArgument(directory, "a directory named like a Minari dataset, NAME-v0", id);
}

absl::Status WriteMinariDataset(const Dataset& dataset, const std::string& directory) {
  ASSIGN_OR_RETURN(const std::string id, MinariId(directory));
  std::error_code error;
  std::filesystem::create_directories(directory + "/data", error);
  if (error) return absl::UnavailableError(absl::StrCat(directory, ": ", error.message()));
  const std::string path = directory + kMinariData, temporary = path + ".tmp";
  ASSIGN_OR_RETURN(Hdf5File file, Hdf5File::Create(temporary));
  RETURN_IF_ERROR(Writer(dataset, &file).Write());
  std::filesystem::rename(temporary, path, error);
  if (error) return absl::UnavailableError(absl::StrCat(path, ": ", error.message()));
  return WriteFileAtomically(directory + kMinariMetadata, {Metadata(dataset, id).dump(2)});
}

}  // namespace spikeserve
