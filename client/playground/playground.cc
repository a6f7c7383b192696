#include "client/playground/playground.h"

#include <cstddef>
#include <optional>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/agent/explanation.h"
#include "core/agent/served_policy.h"
#include "core/agent/session_request.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/engine/energy.h"
#include "core/engine/factory/engine_factory.h"
#include "core/engine/trace.h"
#include "core/model/policy_file.h"
#include "core/session/session.h"
#include "core/session/session_value.h"
#include "nlohmann/json.hpp"

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

// Returns the last decision of a session without its inside: rasters, attention and routing are
// empty. REQUIRES: the running episode has a decision.
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

// Adds the inside of a decision.
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

std::shared_ptr<const ServedPolicy> Serve(Policy policy) {
  const auto shared = std::make_shared<const Policy>(std::move(policy));
  auto served = std::make_shared<ServedPolicy>();
  served->name = "policy";  // sessions need a name, but only a server has several policies
  served->version = 1;
  served->engine = MakeEngine(shared);
  served->heads = std::make_shared<TenantHeads>(shared);
  served->observer = std::make_shared<SessionObserver>();
  return served;
}

absl::Status CheckFits(const Policy& policy, const Environment& environment) {
  if (policy.observation_size() == environment.observation_size() &&
      policy.action_space == environment.action_space()) {
    return absl::OkStatus();
  }
  return absl::InvalidArgumentError(
      absl::StrCat("policy: expected the ", environment.observation_size(),
                   " observations and the actions of ", environment.id(), ", received ",
                   policy.observation_size(), " observations, or other actions"));
}

}  // namespace

absl::StatusOr<std::unique_ptr<Playground>> Playground::Open(absl::string_view policy_file,
                                                             uint64_t seed) {
  ASSIGN_OR_RETURN(Policy policy, ParsePolicyFile(policy_file));
  ASSIGN_OR_RETURN(auto environment, MakeEnvironment(policy.environment));
  RETURN_IF_ERROR(CheckFits(policy, *environment));
  const auto served = Serve(std::move(policy));
  ASSIGN_OR_RETURN(SessionOptions options, ResolveSession({}, *served));
  return std::unique_ptr<Playground>(new Playground(
      served, std::move(environment), NewSession("playground", std::move(options)), seed));
}

Playground::Playground(std::shared_ptr<const ServedPolicy> served,
                       std::unique_ptr<Environment> environment, Session session, uint64_t seed)
    : served_(std::move(served)),
      environment_(std::move(environment)),
      agent_(served_, std::move(session), &clock_),
      seed_(seed) {
  state_.observation = environment_->Reset(seed_);
}

absl::StatusOr<nlohmann::json> Playground::Step() {
  if (state_.done()) {
    RETURN_IF_ERROR(BeginEpisode());
  }
  ASSIGN_OR_RETURN(const auto answer,
                   agent_.Act(/*step=*/std::nullopt, state_.observation, state_.reward));
  nlohmann::json decision = DecisionToJson(*served_, agent_.session());
  state_ = environment_->Step(answer->action);
  episode_return_ += state_.reward;
  AddEpisode(&decision);
  return decision;
}

absl::StatusOr<nlohmann::json> Playground::Explain() const {
  ASSIGN_OR_RETURN(const auto explanation,
                   spikeserve::Explain(served_->engine->CompletePolicy(), agent_.session()));
  nlohmann::json decision = DecisionToJson(*served_, agent_.session());
  AddTrace(explanation.trace, &decision);
  AddEpisode(&decision);
  return decision;
}

absl::Status Playground::BeginEpisode() {
  RETURN_IF_ERROR(
      agent_.EndEpisode({.reward = state_.reward, .terminated = state_.terminated}).status());
  state_ = {.observation = environment_->Reset(++seed_)};
  episode_return_ = 0.0;
  return absl::OkStatus();
}

void Playground::AddEpisode(nlohmann::json* decision) const {
  (*decision)["environment"] = std::string(environment_->id());
  (*decision)["seed"] = seed_;
  (*decision)["episode_return"] = episode_return_;
  (*decision)["ended"] = state_.done();
}

}  // namespace spikeserve
