#include "train/evaluation/ablation.h"

#include <algorithm>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

void Clear(Tensor* tensor) { std::fill(tensor->values.begin(), tensor->values.end(), 0.0f); }

// The columns that stand after the d coder columns.
void ClearPhaseColumns(int hidden_size, Tensor* weight) {
  const int columns = weight->shape[1];
  for (size_t i = 0; i < weight->values.size(); ++i) {
    if (static_cast<int>(i) % columns >= hidden_size) weight->values[i] = 0.0f;
  }
}

absl::Status Missing(absl::string_view part, const ModelConfig& config) {
  return absl::InvalidArgumentError(absl::StrCat("ablate: a policy of mode ",
                                                 std::string(ToString(config.mode)), " has no ",
                                                 part, " to switch off"));
}

}  // namespace

absl::Status Ablate(absl::string_view part, Policy* policy) {
  ModelConfig& config = policy->config;
  Weights& weights = policy->weights;
  if (part == "context") {
    config.context = 1;
  } else if (part == "return") {
    Clear(&weights.embed_return.linear.weight);
  } else if (part == "attention") {
    if (config.is_dense()) return Missing(part, config);
    for (LayerWeights& layer : weights.layers) Clear(&layer.scale);
  } else if (part == "phase") {
    if (!config.has_phase()) return Missing(part, config);
    for (LayerWeights& layer : weights.layers) {
      for (Linear* linear : {&layer.query, &layer.key, &layer.value}) {
        ClearPhaseColumns(config.hidden_size, &linear->weight);
      }
    }
  } else if (part == "routing") {
    if (!config.has_routing()) return Missing(part, config);
    for (LayerWeights& layer : weights.layers) {
      Clear(&layer.routing_gate.weight);
      Clear(&layer.routing_gate.bias);
    }
  } else {
    return absl::InvalidArgumentError(absl::StrCat(
        "ablate: expected context, attention, phase, routing or return, received '", part, "'"));
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
