#include "train/evaluation/ablation.h"

#include "absl/strings/str_cat.h"
#include "core/math/vector_view.h"

namespace spikeserve {
namespace {

void Clear(Tensor* tensor) { AsVector(tensor->values).setZero(); }

// Clears the columns after the d coder columns.
void ClearPhaseColumns(int hidden_size, Tensor* weight) {
  const int phase_columns = weight->shape[1] - hidden_size;
  AsMatrix(weight->values, weight->shape[0]).rightCols(phase_columns).setZero();
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
