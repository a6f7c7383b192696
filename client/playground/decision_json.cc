#include "client/playground/decision_json.h"

#include <cstddef>
#include <string>
#include <utility>

#include "core/contract/dcheck.h"
#include "core/engine/energy.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

Json ToJson(const TokenName& name) {
  static constexpr const char* kKinds[] = {"RETURN_TO_GO", "STATE", "ACTION"};
  return {{"kind", kKinds[static_cast<size_t>(name.kind)]}, {"timestep", name.timestep}};
}

Json ToJson(const std::vector<TokenName>& names) {
  Json tokens = Json::array();
  for (const TokenName& name : names) tokens.push_back(ToJson(name));
  return tokens;
}

Json ToJson(const PopulationTrace& population) {
  Json raster = {{"stage", std::string(ToString(population.stage))},
                 {"token", ToJson(population.token)},
                 {"population", population.spikes[0].size()},
                 {"ticks", Json::array()},
                 {"neurons", Json::array()}};
  if (population.layer != kNoLayer) raster["layer"] = population.layer;
  for (size_t tick = 0; tick < population.spikes.size(); ++tick) {
    for (size_t neuron = 0; neuron < population.spikes[tick].size(); ++neuron) {
      if (population.spikes[tick][neuron] == 0) continue;
      raster["ticks"].push_back(tick);
      raster["neurons"].push_back(neuron);
    }
  }
  return raster;
}

Json ToJson(const Action& action, bool is_discrete) {
  if (is_discrete) return {{"discrete", action.discrete}};
  return {{"continuous", {{"values", action.continuous}}}};
}

Json ToJson(const Counts& counts, const ModelConfig& config) {
  Json stages = Json::object();
  for (const auto& [stage, name] : EnumNames(Stage())) {
    if (counts.spikes(stage) > 0) stages[std::string(name)] = counts.spikes(stage);
  }
  Json json = {{"spikes", counts.total_spikes()},
               {"spikes_by_stage", stages},
               {"synaptic_operations", counts.synaptic_operations()},
               {"energy_joules", DefaultEnergy(counts, config)}};
  for (const auto& [field, model] : {std::pair("int_sram_energy_joules", EnergyModel::kIntSram45nm),
                                     std::pair("int_energy_joules", EnergyModel::kInt45nm)}) {
    if (const auto joules = EstimateEnergy(model, counts, config)) json[field] = *joules;
  }
  return json;
}

}  // namespace

Json DecisionToJson(const ServedPolicy& served, const Session& session) {
  SPIKESERVE_DCHECK(session.last_answer.has_value());
  const Policy& policy = served.policy();
  const ModelConfig& config = policy.config;
  const Answer& answer = *session.last_answer;
  const auto observation = session.history.observation(session.history.size() - 1);
  return {{"mode", std::string(ToString(config.mode))},
          {"layers", config.layers},
          {"heads", config.heads},
          {"ticks", config.is_dense() ? 1 : config.ticks},
          {"episode", session.episode},
          {"observation", std::vector<float>(observation.begin(), observation.end())},
          {"logits", answer.logits},
          {"answer",
           {{"step", answer.step},
            {"action", ToJson(answer.action, policy.action_space.is_discrete())},
            {"action_probabilities", answer.probabilities},
            {"return_to_go", answer.return_to_go},
            {"stats", ToJson(answer.counts, config)}}},
          {"rasters", Json::array()},
          {"attention", Json::array()},
          {"routing", Json::array()}};
}

void AddTrace(const Trace& trace, Json* decision) {
  for (const PopulationTrace& population : trace.populations) {
    (*decision)["rasters"].push_back(ToJson(population));
  }
  const Json& ticks = (*decision)["ticks"];
  for (size_t layer = 0; layer < trace.layers.size(); ++layer) {
    const LayerTrace& inside = trace.layers[layer];
    (*decision)["attention"].push_back({{"layer", layer},
                                        {"ticks", ticks},
                                        {"keys", ToJson(inside.keys)},
                                        {"weights", inside.attention}});
    if (inside.gated.empty()) continue;
    (*decision)["routing"].push_back(
        {{"layer", layer}, {"tokens", ToJson(inside.gated)}, {"gates", inside.gates}});
  }
}

}  // namespace spikeserve
