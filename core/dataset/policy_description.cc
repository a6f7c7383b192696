#include "core/dataset/policy_description.h"

#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "core/base/json_object.h"
#include "core/base/status_macros.h"
#include "core/model/wiring_fit.h"

namespace spikeserve {
namespace {

std::vector<std::string> NamesIn(const nlohmann::json& recipe, const char* key) {
  std::vector<std::string> names;
  const auto member = recipe.is_object() ? recipe.find(key) : recipe.end();
  if (member == recipe.end() || !ReadJson(key, *member, &names).ok()) return {};
  return names;
}

std::vector<Feature> FeaturesIn(const nlohmann::json& recipe, const char* key) {
  std::vector<Feature> features;
  for (std::string& name : NamesIn(recipe, key)) features.push_back({.name = std::move(name)});
  return features;
}

absl::Status CheckRecorded(const std::string& field, std::vector<std::string> names,
                           const std::vector<Feature>& expected) {
  if (names.empty() || expected.empty()) return absl::OkStatus();
  return CheckNames(expected, {.field = field, .names = std::move(names), .units = {}},
                    /*in_any_order=*/false);
}

}  // namespace

void AddNames(const nlohmann::json& recipe, Policy* policy) {
  const int obs = policy->observation_size();
  const int act = policy->action_space.size();
  Features named = policy->features;
  if (named.observation.empty()) named.observation = FeaturesIn(recipe, "observation_names");
  if (named.Validate(obs, act).ok()) policy->features = named;
  named = policy->features;
  if (named.action.empty()) named.action = FeaturesIn(recipe, "action_names");
  if (named.Validate(obs, act).ok()) policy->features = std::move(named);
}

absl::Status CheckRecordedNames(const nlohmann::json& recipe, const Policy& policy) {
  RETURN_IF_ERROR(CheckRecorded("observation", NamesIn(recipe, "observation_names"),
                                policy.features.observation));
  return CheckRecorded("action", NamesIn(recipe, "action_names"), policy.features.action);
}

absl::Status AddWiringModel(absl::Span<const Episode> episodes, Policy* policy) {
  const auto act = static_cast<size_t>(policy->action_space.size());
  WiringFit fit(static_cast<size_t>(policy->observation_size()), act);
  std::vector<float> actions;
  for (const Episode& episode : episodes) {
    actions.resize(episode.actions.size() * act);
    for (size_t t = 0; t < episode.actions.size(); ++t) {
      policy->action_space.Encode(episode.actions[t],
                                  absl::MakeSpan(actions).subspan(t * act, act));
    }
    fit.Add(episode.observations, actions);
  }
  ASSIGN_OR_RETURN(auto model, fit.Finish());
  policy->wiring = std::make_shared<const WiringModel>(std::move(model));
  return absl::OkStatus();
}

}  // namespace spikeserve
