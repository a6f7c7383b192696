#include "core/dataset/dataset.h"

#include <algorithm>
#include <iterator>
#include <tuple>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/types/span.h"
#include "core/base/file.h"
#include "core/base/status.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

constexpr char kFormat[] = "spikeserve.dataset.v1";

Json ActionsToJson(const std::vector<Action>& actions, bool discrete) {
  Json list = Json::array();
  for (const Action& action : actions) {
    list.push_back(discrete ? Json(action.discrete) : Json(action.continuous));
  }
  return list;
}

Json ServedToJson(const ServedEpisode& served) {
  Json json = {{"policy", served.policy},
               {"version", served.version},
               {"episode", served.episode},
               {"target_return", served.target_return},
               {"seed", served.seed},
               {"learning", served.learning},
               {"labels", served.labels},
               {"returns_to_go", served.returns_to_go},
               {"probabilities", served.probabilities},
               {"spikes", served.spikes}};
  if (served.temperature.has_value()) json["temperature"] = *served.temperature;
  return json;
}

// May throw Json::exception on a field of the wrong type, like its caller.
ServedEpisode ServedFromJson(const Json& json) {
  ServedEpisode served;
  json.at("policy").get_to(served.policy);
  json.at("version").get_to(served.version);
  json.at("episode").get_to(served.episode);
  json.at("target_return").get_to(served.target_return);
  json.at("seed").get_to(served.seed);
  json.at("learning").get_to(served.learning);
  json.at("labels").get_to(served.labels);
  json.at("returns_to_go").get_to(served.returns_to_go);
  json.at("probabilities").get_to(served.probabilities);
  json.at("spikes").get_to(served.spikes);
  if (json.contains("temperature")) served.temperature = json["temperature"].get<float>();
  return served;
}

Json EpisodeToJson(const Episode& episode, bool discrete) {
  Json json = {{"actor", episode.actor},
               {"seed", episode.seed},
               {"observations", episode.observations},
               {"actions", ActionsToJson(episode.actions, discrete)},
               {"rewards", episode.rewards},
               {"terminated", episode.terminated},
               {"truncated", episode.truncated}};
  if (!episode.labels.empty()) json["labels"] = ActionsToJson(episode.labels, discrete);
  if (!episode.weights.empty()) json["weights"] = episode.weights;
  if (episode.asked_return.has_value()) json["asked_return"] = *episode.asked_return;
  if (episode.served.has_value()) json["served"] = ServedToJson(*episode.served);
  return json;
}

// May throw Json::exception on a field of the wrong type, like its caller.
std::vector<Action> ActionsFromJson(const Json& list, bool discrete) {
  std::vector<Action> actions;
  for (const Json& item : list) {
    Action& action = actions.emplace_back();
    if (discrete) {
      item.get_to(action.discrete);
    } else {
      item.get_to(action.continuous);
    }
  }
  return actions;
}

// May throw Json::exception on a field of the wrong type; ReadDataset catches it.
Episode EpisodeFromJson(const Json& json, bool discrete) {
  Episode episode;
  json.at("actor").get_to(episode.actor);
  json.at("seed").get_to(episode.seed);
  json.at("observations").get_to(episode.observations);
  episode.actions = ActionsFromJson(json.at("actions"), discrete);
  if (json.contains("labels")) episode.labels = ActionsFromJson(json["labels"], discrete);
  if (json.contains("weights")) json["weights"].get_to(episode.weights);
  if (json.contains("asked_return")) episode.asked_return = json["asked_return"].get<double>();
  if (json.contains("served")) episode.served = ServedFromJson(json["served"]);
  json.at("rewards").get_to(episode.rewards);
  json.at("terminated").get_to(episode.terminated);
  json.at("truncated").get_to(episode.truncated);
  return episode;
}

absl::Status CheckServed(const Dataset& dataset, const ServedEpisode& served, size_t steps) {
  const size_t n = dataset.action_space.is_discrete() ? dataset.action_space.n : 0;
  const std::tuple<const char*, size_t, size_t> lengths[] = {
      {"returns_to_go", served.returns_to_go.size(), steps},
      {"probabilities", served.probabilities.size(), steps * n},
      {"spikes", served.spikes.size(), steps}};
  for (const auto& [field, length, expected] : lengths) {
    if (length == expected) continue;
    return absl::InvalidArgumentError(
        absl::StrCat("served.", field, ": expected ", expected, ", received ", length));
  }
  return absl::OkStatus();
}

absl::StatusOr<Dataset> DatasetFromJson(const Json& json) {
  if (json.value("format", "") != kFormat) {
    return absl::InvalidArgumentError(absl::StrCat("format: expected ", kFormat));
  }
  Dataset dataset;
  json.at("environment").get_to(dataset.environment);
  json.at("observation_size").get_to(dataset.observation_size);
  dataset.recipe = json.at("recipe");
  const Json& space = json.at("action_space");
  dataset.action_space = space.contains("n") ? ActionSpace::Discrete(space.at("n"))
                                             : ActionSpace::Box(space.at("low"), space.at("high"));
  for (const Json& item : json.at("episodes")) {
    dataset.episodes.push_back(EpisodeFromJson(item, dataset.action_space.is_discrete()));
    if (auto status = CheckEpisode(dataset, dataset.episodes.back()); !status.ok()) {
      return Annotate(status, absl::StrCat("episode ", dataset.episodes.size() - 1));
    }
  }
  if (dataset.episodes.empty())
    return absl::InvalidArgumentError("episodes: expected at least one");
  return dataset;
}

}  // namespace

absl::Status CheckEpisode(const Dataset& dataset, const Episode& episode) {
  const size_t steps = episode.actions.size();
  if (steps == 0)
    return absl::InvalidArgumentError("actions: expected at least one, received none");
  if (episode.rewards.size() != steps) {
    return absl::InvalidArgumentError(
        absl::StrCat("rewards: expected ", steps, ", received ", episode.rewards.size()));
  }
  const size_t numbers = (steps + 1) * dataset.observation_size;
  if (episode.observations.size() != numbers) {
    return absl::InvalidArgumentError(absl::StrCat(
        "observations: expected ", numbers, " numbers, received ", episode.observations.size()));
  }
  if (!episode.labels.empty() && episode.labels.size() != steps) {
    return absl::InvalidArgumentError(
        absl::StrCat("labels: expected ", steps, " or none, received ", episode.labels.size()));
  }
  if (!episode.weights.empty() && episode.weights.size() != steps) {
    return absl::InvalidArgumentError(
        absl::StrCat("weights: expected ", steps, " or none, received ", episode.weights.size()));
  }
  for (const auto* actions : {&episode.actions, &episode.labels}) {
    for (const Action& action : *actions) {
      if (auto status = dataset.action_space.Contains(action); !status.ok()) return status;
    }
  }
  return episode.served.has_value() ? CheckServed(dataset, *episode.served, steps)
                                    : absl::OkStatus();
}

absl::StatusOr<Dataset> Concatenate(std::vector<Dataset> datasets) {
  Dataset all = std::move(datasets[0]);
  if (datasets.size() == 1) return all;
  Json recipes = Json::array({std::move(all.recipe)});
  for (Dataset& dataset : absl::MakeSpan(datasets).subspan(1)) {
    if (dataset.environment != all.environment) {
      return absl::InvalidArgumentError(absl::StrCat("data: expected all of ", all.environment,
                                                     ", received one of ", dataset.environment));
    }
    recipes.push_back(std::move(dataset.recipe));
    std::move(dataset.episodes.begin(), dataset.episodes.end(), std::back_inserter(all.episodes));
  }
  all.recipe = Json{{"parts", std::move(recipes)}};
  return all;
}

absl::Status WriteDataset(const Dataset& dataset, const std::string& path) {
  const bool discrete = dataset.action_space.is_discrete();
  Json space = discrete
                   ? Json{{"n", dataset.action_space.n}}
                   : Json{{"low", dataset.action_space.low}, {"high", dataset.action_space.high}};
  Json json = {{"format", kFormat},
               {"environment", dataset.environment},
               {"observation_size", dataset.observation_size},
               {"action_space", std::move(space)},
               {"recipe", dataset.recipe},
               {"episodes", Json::array()}};
  for (const Episode& episode : dataset.episodes) {
    json["episodes"].push_back(EpisodeToJson(episode, discrete));
  }
  std::string bytes;
  Json::to_cbor(json, bytes);
  return WriteFileAtomically(path, {bytes});
}

absl::StatusOr<Dataset> ReadDataset(const std::string& path) {
  const absl::StatusOr<std::string> bytes = ReadFile(path);
  if (!bytes.ok()) return bytes.status();
  try {
    absl::StatusOr<Dataset> dataset = DatasetFromJson(Json::from_cbor(*bytes));
    if (dataset.ok()) return dataset;
    return Annotate(dataset.status(), path);
  } catch (const Json::exception& error) {
    return absl::InvalidArgumentError(absl::StrCat(path, ": not a dataset: ", error.what()));
  }
}

}  // namespace spikeserve
