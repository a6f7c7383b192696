#include "train/evaluation/neurobench.h"

#include <algorithm>
#include <utility>
#include <variant>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/base/status.h"
#include "core/engine/factory/engine_factory.h"
#include "core/engine/token.h"
#include "core/engine/token_costs.h"

namespace spikeserve {
namespace {

struct Parameters {
  uint64_t bytes = 0;
  uint64_t weights = 0;
  uint64_t zeros = 0;  // of the weights
};

Parameters CountParameters(const Policy& policy) {
  Parameters parameters;
  Weights weights = policy.weights;
  for (const TensorSlot& slot : TensorSlots(policy.config, policy.observation_size(),
                                            policy.action_space.size(), &weights)) {
    const bool is_map = absl::EndsWith(slot.name, ".weight") && slot.shape.size() == 2;
    std::visit(
        [&](const auto* tensor) {
          parameters.bytes += tensor->values.size() * sizeof(tensor->values[0]);
          if (!is_map) return;
          parameters.weights += tensor->values.size();
          parameters.zeros +=
              static_cast<uint64_t>(std::count(tensor->values.begin(), tensor->values.end(), 0));
        },
        slot.tensor);
  }
  return parameters;
}

// Returns the products of all maps that a token passes, zeros included. `inputs` is the length of
// its embedding's input. A state token includes the action head.
uint64_t DenseProducts(const Policy& policy, TokenKind kind, int inputs) {
  const ModelConfig& config = policy.config;
  const auto size = [](int value) { return static_cast<uint64_t>(value); };
  const uint64_t d = size(config.hidden_size);
  const uint64_t ticks = size(config.ticks);
  const uint64_t projection = ticks * size(config.attention_inputs()) * d;
  const uint64_t routing = config.has_routing()
                               ? size(config.attention_planes()) *
                                     size(config.routing_hidden_size) * (d + size(config.heads))
                               : 0;
  // The query, routing, the output of the attention, and the FFN, whose input has ticks.
  const uint64_t output = projection + routing + size(config.merged_size()) * d +
                          (ticks + 1) * d * size(config.ffn_size);
  const bool is_state = kind == TokenKind::kState;
  const uint64_t layers = size(config.layers);
  return size(inputs) * d + layers * 2 * projection + (is_state ? layers : layers - 1) * output +
         (is_state ? size(policy.action_space.size()) * d : 0);
}

// Returns the neurons times ticks of a token, coders included, in every arithmetic.
uint64_t Activations(const ModelConfig& config, TokenKind kind) {
  Counts counts;
  AddTokenCosts(config, kind, /*keys=*/0, &counts);
  return counts.membrane_updates;
}

void DecideEpisode(const Engine& engine, const Dataset& dataset, const Episode& episode,
                   Evaluation* evaluation) {
  const Policy& policy = engine.policy();
  const auto context = engine.NewContext();
  Engine::Output output;
  std::vector<float> action(static_cast<size_t>(policy.action_space.size()));
  const auto size = static_cast<size_t>(dataset.observation_size);
  for (size_t step = 0; step < episode.actions.size(); ++step) {
    engine.Decide(*context, episode.served->returns_to_go[step],
                  absl::MakeConstSpan(episode.observations).subspan(step * size, size), &output);
    evaluation->counts += output.counts;
    ++evaluation->decisions;
    policy.action_space.Encode(episode.actions[step], absl::MakeSpan(action));
    engine.AppendAction(*context, action);
  }
  evaluation->returns.push_back(0.0);  // one per episode; not used here
}

}  // namespace

absl::Status CheckServedEpisode(const Policy& policy, const Dataset& dataset,
                                const Episode& episode) {
  if (dataset.observation_size != policy.observation_size()) {
    return InvalidArgument("observation", absl::StrCat(policy.observation_size(), " numbers"),
                           dataset.observation_size);
  }
  if (!(dataset.action_space == policy.action_space)) {
    return InvalidArgument("action_space", "that of the policy", "another one");
  }
  if (episode.served.has_value()) return absl::OkStatus();
  return InvalidArgument("episode", "one that a server recorded", "another");
}

absl::StatusOr<NeuroBench> MeasureNeuroBench(const Policy& policy, const Evaluation& evaluation) {
  const ModelConfig& config = policy.config;
  if (config.is_dense()) {
    return InvalidArgument("mode", "a spiking one", "dense");
  }
  const Counts& counts = evaluation.counts;
  const Parameters parameters = CountParameters(policy);
  const auto decisions = static_cast<double>(evaluation.decisions);
  const auto mean = [&](uint64_t count) { return static_cast<double>(count) / decisions; };
  const uint64_t spikes = counts.total_spikes() - counts.spikes(Stage::kPhase);
  // The first decision of an episode has no action token.
  const uint64_t actions = evaluation.decisions - evaluation.returns.size();
  const uint64_t activations = evaluation.decisions * (Activations(config, TokenKind::kReturn) +
                                                       Activations(config, TokenKind::kState)) +
                               actions * Activations(config, TokenKind::kAction);
  const uint64_t dense =
      evaluation.decisions * (DenseProducts(policy, TokenKind::kReturn, 1) +
                              DenseProducts(policy, TokenKind::kState,
                                            config.state_inputs(policy.observation_size()))) +
      actions * DenseProducts(policy, TokenKind::kAction, policy.action_space.size());
  return NeuroBench{
      .decisions = evaluation.decisions,
      .footprint_bytes = parameters.bytes,
      .connection_sparsity =
          static_cast<double>(parameters.zeros) / static_cast<double>(parameters.weights),
      .activation_sparsity = 1.0 - static_cast<double>(spikes) / static_cast<double>(activations),
      .effective_acs = mean(counts.accumulates),
      .effective_macs = mean(counts.multiply_accumulates),
      .dense = mean(dense),
      .attention_products = mean(counts.attention_products),
      .membrane_updates = mean(counts.membrane_updates)};
}

absl::StatusOr<Evaluation> DecideAgain(std::shared_ptr<const Policy> policy,
                                       const std::vector<Dataset>& recordings) {
  Evaluation evaluation = {.options = {},
                           .environment = policy->environment,
                           .returns = {},
                           .decisions = 0,
                           .counts = {}};
  const std::unique_ptr<Engine> engine = MakeEngine(policy);
  for (const Dataset& dataset : recordings) {
    for (const Episode& episode : dataset.episodes) {
      if (absl::Status status = CheckServedEpisode(*policy, dataset, episode); !status.ok()) {
        return status;
      }
      DecideEpisode(*engine, dataset, episode, &evaluation);
    }
  }
  return evaluation;
}

nlohmann::ordered_json ToJson(const NeuroBench& metrics) {
  return {{"decisions", metrics.decisions},
          {"Footprint", metrics.footprint_bytes},
          {"ConnectionSparsity", metrics.connection_sparsity},
          {"ActivationSparsity", metrics.activation_sparsity},
          {"SynapticOperations",
           {{"Effective_ACs", metrics.effective_acs},
            {"Effective_MACs", metrics.effective_macs},
            {"Dense", metrics.dense}}},
          {"attention_products", metrics.attention_products},
          {"membrane_updates", metrics.membrane_updates}};
}

std::string ToText(const NeuroBench& metrics) {
  return absl::StrFormat(
      "footprint %d bytes; connection sparsity %.4f; activation sparsity %.4f\n"
      "per decision, mean of %d: effective ACs %.1f, effective MACs %.1f, dense %.1f\n"
      "beside NeuroBench's metrics: attention products %.1f, membrane updates %.1f\n",
      metrics.footprint_bytes, metrics.connection_sparsity, metrics.activation_sparsity,
      metrics.decisions, metrics.effective_acs, metrics.effective_macs, metrics.dense,
      metrics.attention_products, metrics.membrane_updates);
}

}  // namespace spikeserve
