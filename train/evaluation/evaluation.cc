#include "train/evaluation/evaluation.h"

#include <algorithm>
#include <cmath>
#include <deque>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/engine/energy.h"
#include "core/engine/factory/engine_factory.h"
#include "core/environment/environment.h"
#include "core/math/vector_view.h"
#include "train/recording/policy_player.h"

namespace spikeserve {
namespace {

// Returns the number of computed tokens: three per decision, but two at the first decision of an
// episode, which has no previous action.
double NewTokens(const Evaluation& evaluation) {
  return 3.0 * static_cast<double>(evaluation.decisions) -
         static_cast<double>(evaluation.returns.size());
}

// The decisions that are under way for `delay` steps.
class UnderWay {
 public:
  UnderWay(const ActionSpace& space, int delay) {
    Action neutral;
    for (int i = 0; i < space.size() && !space.is_discrete(); ++i) {
      const float low = space.low[i], high = space.high[i];
      neutral.continuous.push_back(low <= 0.0f && high >= 0.0f ? 0.0f : (low + high) / 2.0f);
    }
    for (int i = 0; i < delay; ++i) actions_.push_back(neutral);
  }

  // Takes the decision of this step and returns the one that is executed.
  Action Next(Action decided) {
    actions_.push_back(std::move(decided));
    Action executed = std::move(actions_.front());
    actions_.pop_front();
    return executed;
  }

 private:
  std::deque<Action> actions_;
};

// Plays one episode and returns its return.
double PlayEpisode(const Engine& engine, Environment& environment, uint64_t seed, int delay,
                   Evaluation* evaluation) {
  UnderWay under_way(engine.policy().action_space, delay);
  PolicyPlayer player(engine, static_cast<double>(engine.policy().target_return));
  StepResult result;
  result.observation = environment.Reset(seed);
  double episode_return = 0.0;
  while (!result.done()) {
    const Action executed = under_way.Next(player.Act(result.observation, result.reward));
    player.Executed(executed);
    result = environment.Step(executed);
    evaluation->counts += player.counts();
    ++evaluation->decisions;
    episode_return += result.reward;
  }
  return episode_return;
}

nlohmann::ordered_json OperationsToJson(const Counts& counts, double decisions,
                                        const ModelConfig& config) {
  const auto mean = [&](uint64_t count) { return static_cast<double>(count) / decisions; };
  nlohmann::ordered_json operations = {
      {"accumulates", mean(counts.accumulates)},
      {"multiply_accumulates", mean(counts.multiply_accumulates)},
      {"integer_multiply_accumulates", mean(counts.integer_multiply_accumulates)},
      {"attention_products", mean(counts.attention_products)},
      {"membrane_updates", mean(counts.membrane_updates)},
      {"coder_gains", mean(counts.coder_gains)},
      {"layer_norm_elements", mean(counts.layer_norm_elements)},
      {"softmax_terms", mean(counts.softmax_terms)},
      {"gate_products", mean(counts.gate_products)}};
  if (!config.is_integer()) return operations;
  operations["driven_neurons"] = mean(counts.driven_neurons);
  operations["membrane_leaks"] = mean(counts.membrane_leaks);
  operations["wide_multiply_accumulates"] = mean(counts.wide_multiply_accumulates);
  operations["attention_scalings"] = mean(counts.attention_scalings);
  operations["weight_bytes"] = mean(counts.weight_bytes);
  operations["attention_bytes"] = mean(counts.attention_bytes);
  return operations;
}

}  // namespace

absl::Status EvaluationOptions::Validate() const {
  if (episodes >= 1) return absl::OkStatus();
  return InvalidArgument("episodes", "at least 1", episodes);
}

double Evaluation::mean_return() const { return AsVector(returns).mean(); }

double Evaluation::std_return() const {
  return std::sqrt((AsVector(returns).array() - mean_return()).square().mean());
}

double Evaluation::spikes_per_decision() const {
  return static_cast<double>(counts.total_spikes()) / static_cast<double>(decisions);
}

absl::StatusOr<Evaluation> Evaluate(std::shared_ptr<const Policy> policy,
                                    const EvaluationOptions& options) {
  RETURN_IF_ERROR(options.Validate());
  ASSIGN_OR_RETURN(std::unique_ptr<Environment> environment, MakeEnvironment(policy->environment));
  RETURN_IF_ERROR(CheckSpacesMatch(*policy, *environment));
  Evaluation evaluation = {.options = options,
                           .environment = policy->environment,
                           .returns = {},
                           .decisions = 0,
                           .counts = {}};
  const std::unique_ptr<Engine> engine = MakeEngine(std::move(policy));
  for (int i = 0; i < options.episodes; ++i) {
    const int delay = options.delay.least + i % (options.delay.most - options.delay.least + 1);
    const uint64_t seed = options.first_seed + static_cast<uint64_t>(i);
    evaluation.returns.push_back(PlayEpisode(*engine, *environment, seed, delay, &evaluation));
  }
  return evaluation;
}

nlohmann::ordered_json ToJson(const Evaluation& evaluation, const ModelConfig& config) {
  const auto decisions = static_cast<double>(evaluation.decisions);
  const auto [least, most] =
      std::minmax_element(evaluation.returns.begin(), evaluation.returns.end());
  nlohmann::ordered_json json = {{"environment", evaluation.environment},
                                 {"mean_return", evaluation.mean_return()},
                                 {"std_return", evaluation.std_return()},
                                 {"min_return", *least},
                                 {"max_return", *most},
                                 {"episodes", evaluation.options.episodes},
                                 {"first_seed", evaluation.options.first_seed},
                                 {"decisions", evaluation.decisions},
                                 {"spikes_per_decision", evaluation.spikes_per_decision()}};
  const DelayRange delay = evaluation.options.delay;
  if (delay.most > 0) json["delay"] = {delay.least, delay.most};
  for (int i = 0; i < kStages; ++i) {
    const auto stage = static_cast<Stage>(i);
    json["spikes_per_decision_by_stage"][std::string(ToString(stage))] =
        static_cast<double>(evaluation.counts.spikes(stage)) / decisions;
  }
  json["spikes_per_token_and_tick"] =
      static_cast<double>(evaluation.counts.total_spikes()) / NewTokens(evaluation) / config.ticks;
  json["spikes_per_window"] = evaluation.spikes_per_decision() * config.context;
  json["window_timesteps"] = config.context;
  json["synaptic_operations_per_decision"] =
      static_cast<double>(evaluation.counts.synaptic_operations()) / decisions;
  json["operations_per_decision"] = OperationsToJson(evaluation.counts, decisions, config);
  for (const auto& [model, name] : EnumNames(EnergyModel())) {
    const auto joules = EstimateEnergy(model, evaluation.counts, config);
    if (!joules.has_value()) continue;
    json["estimated_energy_joules_per_decision"][std::string(name)] = *joules / decisions;
  }
  return json;
}

std::string ToText(const Evaluation& evaluation, const ModelConfig& config) {
  const nlohmann::ordered_json json = ToJson(evaluation, config);
  std::string text = absl::StrFormat(
      "%s, %d episodes from seed %d: return %.2f ± %.2f (%.1f to %.1f)\n"
      "spikes per decision %.1f; per token and tick (S-bar) %.3f; per window of %d timesteps %.0f\n"
      "by stage, per decision:",
      evaluation.environment, evaluation.options.episodes, evaluation.options.first_seed,
      evaluation.mean_return(), evaluation.std_return(), json["min_return"].get<double>(),
      json["max_return"].get<double>(), evaluation.spikes_per_decision(),
      json["spikes_per_token_and_tick"].get<double>(), config.context,
      json["spikes_per_window"].get<double>());
  for (const auto& [stage, spikes] : json["spikes_per_decision_by_stage"].items()) {
    absl::StrAppendFormat(&text, " %s %.1f", stage, spikes.get<double>());
  }
  text += "\noperations, per decision:";
  for (const auto& [kind, count] : json["operations_per_decision"].items()) {
    absl::StrAppendFormat(&text, " %s %.0f", kind, count.get<double>());
  }
  text += "\nestimated energy, per decision:";
  for (const auto& [model, joules] : json["estimated_energy_joules_per_decision"].items()) {
    absl::StrAppendFormat(&text, " %s %.1f nJ", model, 1e9 * joules.get<double>());
  }
  return text + "\n";
}

}  // namespace spikeserve
