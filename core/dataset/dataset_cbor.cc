#include "core/dataset/dataset_cbor.h"

#include <cmath>
#include <limits>
#include <optional>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "core/base/cbor.h"
#include "core/base/enum_names.h"
#include "core/base/fields.h"
#include "core/base/json.h"
#include "core/base/json_object.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {

namespace {

using Json = nlohmann::json;

}  // namespace

// Reads an index of a Discrete space or the values of a Box.
absl::Status ReadJson(absl::string_view field, const Json& json, Action* action) {
  return json.is_array() ? ReadJson(field, json, &action->continuous)
                         : ReadJson(field, json, &action->discrete);
}

// Reads what ToString() returns.
absl::Status ReadJson(absl::string_view field, const Json& json, StepSource* source) {
  std::string text;
  RETURN_IF_ERROR(ReadJson(field, json, &text));
  const std::pair<absl::string_view, absl::string_view> parts =
      absl::StrSplit(text, absl::MaxSplits(':', 1));
  ASSIGN_OR_RETURN(source->kind, ParseEnum<SourceKind>(field, parts.first));
  source->operator_id = std::string(parts.second);
  return absl::OkStatus();
}

SPIKESERVE_FIELDS(ServedEpisode, policy, version, episode, target_return, seed, learning, labels,
                  returns_to_go, probabilities, spikes)

absl::Status ReadJson(absl::string_view field, const Json& json, ServedEpisode* served) {
  JsonObject object(field, json);
  VisitFields(*served, [&](const char* key, auto& member) { object.Required(key, &member); });
  object.Optional("temperature", &served->temperature);
  object.Optional("answered_actions", &served->answered_actions);
  object.Optional("sources", &served->sources);
  object.Optional("logits", &served->logits);
  object.Optional("noise", &served->noise);
  object.Optional("policy_sha256", &served->policy_sha256);
  object.Optional("session", &served->session);
  object.Optional("tenant", &served->tenant);
  object.Optional("received_rewards", &served->received_rewards);
  object.Optional("success", &served->success);
  object.Optional("verdict", &served->verdict);
  return object.Finish();
}

absl::Status ReadJson(absl::string_view field, const Json& json, ActionSpace* space) {
  JsonObject object(field, json);
  if (json.contains("n")) {
    object.Required("n", &space->n);
  } else {
    object.Required("low", &space->low);
    object.Required("high", &space->high);
  }
  const auto status = object.Finish();
  return status.ok() ? space->Validate() : status;
}

namespace {

constexpr char kDatasetFormat[] = "spikeserve.dataset.v1";

Json ActionsToJson(const std::vector<Action>& actions, bool discrete) {
  Json list = Json::array();
  for (const Action& action : actions) {
    list.push_back(discrete ? Json(action.discrete) : Json(action.continuous));
  }
  return list;
}

Json ServedToJson(const ServedEpisode& served, bool discrete) {
  Json json;
  VisitFields(served, [&](const char* key, const auto& member) { json[key] = member; });
  if (served.temperature.has_value()) json["temperature"] = *served.temperature;
  if (!served.policy_sha256.empty()) json["policy_sha256"] = served.policy_sha256;
  if (!served.session.empty()) json["session"] = served.session;
  if (!served.tenant.empty()) json["tenant"] = served.tenant;
  if (!served.received_rewards.empty()) json["received_rewards"] = served.received_rewards;
  if (served.success.has_value()) json["success"] = *served.success;
  if (!served.verdict.empty()) json["verdict"] = served.verdict;
  if (!served.noise.empty()) {
    json["logits"] = served.logits;
    json["noise"] = served.noise;
  }
  if (!served.answered_actions.empty()) {
    json["answered_actions"] = ActionsToJson(served.answered_actions, discrete);
  }
  for (const StepSource& source : served.sources) json["sources"].push_back(ToString(source));
  return json;
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
  if (episode.target_return.has_value()) json["asked_return"] = *episode.target_return;
  if (episode.served.has_value()) json["served"] = ServedToJson(*episode.served, discrete);
  return json;
}

// Reads the member `key`, a list of indices or of vectors, as actions.
void ReadActions(const char* key, bool discrete, bool required, JsonObject* object,
                 std::vector<Action>* actions) {
  const auto read = [&](auto* values) {
    if (required) {
      object->Required(key, values);
    } else {
      object->Optional(key, values);
    }
  };
  if (discrete) {
    std::vector<int> indices;
    read(&indices);
    for (const int index : indices) actions->push_back({.discrete = index, .continuous = {}});
  } else {
    std::vector<std::vector<float>> vectors;
    read(&vectors);
    for (auto& vector : vectors) {
      actions->push_back({.discrete = 0, .continuous = std::move(vector)});
    }
  }
}

// Returns an infinity for what float cannot hold. CheckEpisode() names its step and element.
float ToFloat(double x) {
  constexpr double kGreatest = std::numeric_limits<float>::max();
  if (std::abs(x) > kGreatest)
    return static_cast<float>(std::copysign(std::numeric_limits<double>::infinity(), x));
  return static_cast<float>(x);
}

absl::Status ReadEpisode(absl::string_view field, const Json& json, bool discrete,
                         Episode* episode) {
  JsonObject object(field, json);
  object.Required("actor", &episode->actor);
  object.Required("seed", &episode->seed);
  std::vector<double> observations;
  object.Required("observations", &observations);
  for (const double x : observations) episode->observations.push_back(ToFloat(x));
  ReadActions("actions", discrete, /*required=*/true, &object, &episode->actions);
  ReadActions("labels", discrete, /*required=*/false, &object, &episode->labels);
  object.Optional("weights", &episode->weights);
  object.Optional("asked_return", &episode->target_return);
  object.Optional("served", &episode->served);
  object.Required("rewards", &episode->rewards);
  object.Required("terminated", &episode->terminated);
  object.Required("truncated", &episode->truncated);
  return object.Finish();
}

absl::StatusOr<Dataset> DatasetFromJson(const Json& json) {
  JsonObject object("dataset", json);
  std::string format;
  Dataset dataset;
  std::vector<Json> episodes;
  object.Required("format", &format);
  object.Required("environment", &dataset.environment);
  object.Required("observation_size", &dataset.observation_size, 1);
  object.Required("recipe", &dataset.recipe);
  object.Required("action_space", &dataset.action_space);
  object.Required("episodes", &episodes);
  RETURN_IF_ERROR(object.Finish());
  if (format != kDatasetFormat) {
    return InvalidArgument("format", kDatasetFormat, Quoted(format));
  }
  for (const Json& item : episodes) {
    const std::string field = absl::StrCat("episode ", dataset.episodes.size());
    Episode& episode = dataset.episodes.emplace_back();
    auto status = ReadEpisode(field, item, dataset.action_space.is_discrete(), &episode);
    if (!status.ok()) return status;
    if (status = AcceptEpisode(dataset, &episode); !status.ok()) return Annotate(status, field);
  }
  if (dataset.episodes.empty()) {
    return InvalidArgument("episodes", "at least one", "none");
  }
  return dataset;
}

}  // namespace

std::string SerializeDataset(const Dataset& dataset) {
  const bool discrete = dataset.action_space.is_discrete();
  Json space = discrete
                   ? Json{{"n", dataset.action_space.n}}
                   : Json{{"low", dataset.action_space.low}, {"high", dataset.action_space.high}};
  Json json = {{"format", kDatasetFormat},
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
  return bytes;
}

absl::StatusOr<Dataset> ParseDataset(absl::string_view bytes) {
  const std::optional<Json> json = ParseCbor(bytes);
  if (!json.has_value())
    return absl::InvalidArgumentError("expected a dataset in CBOR with texts in UTF-8");
  return DatasetFromJson(*json);
}

}  // namespace spikeserve
