#include "train/evaluation/ablation.h"

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/math/vector_view.h"

namespace spikeserve {
namespace {

void Clear(auto* tensor) { AsVector(tensor->values).setZero(); }

// Clears the columns from number `first` on of a matrix of float32 or int8 numbers.
void ClearColumnsFrom(int first, auto* weight) {
  const auto columns = static_cast<size_t>(weight->shape[1]);
  for (size_t i = 0; i < weight->values.size(); ++i) {
    if (i % columns >= static_cast<size_t>(first)) weight->values[i] = 0;
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
  } else if (part == "changes") {
    if (!config.observation_changes) {
      return InvalidArgument("ablate", "a policy with observation changes", "one without");
    }
    if (config.is_integer()) {
      ClearColumnsFrom(policy->observation_size(), &weights.fixed_point.embed_state.linear.weight);
    } else {
      ClearColumnsFrom(policy->observation_size(), &weights.embed_state.linear.weight);
    }
  } else if (part == "return") {
    Clear(&weights.embed_return.linear.weight);
    Clear(&weights.fixed_point.embed_return.linear.weight);
  } else if (part == "attention") {
    if (config.is_dense()) return Missing(part, config);
    for (LayerWeights& layer : weights.layers) {
      Clear(&layer.scale);
      Clear(&layer.fixed_point.attention_scale);
    }
  } else if (part == "phase") {
    if (!config.has_phase()) return Missing(part, config);
    const auto clear = [&config](auto& maps) {
      for (auto* map : {&maps.query, &maps.key, &maps.value}) {
        ClearColumnsFrom(config.hidden_size, &map->weight);  // the coder comes first
      }
    };
    for (LayerWeights& layer : weights.layers) {
      config.is_integer() ? clear(layer.integer) : clear(layer);
    }
  } else if (part == "routing") {
    if (!config.has_routing()) return Missing(part, config);
    for (LayerWeights& layer : weights.layers) {
      Clear(&layer.routing_gate.weight);
      Clear(&layer.routing_gate.bias);
      Clear(&layer.fixed_point.routing_gate.weight);
      Clear(&layer.fixed_point.routing_gate.bias);
    }
  } else {
    return InvalidArgument("ablate", "context, changes, attention, phase, routing or return",
                           absl::StrCat("'", part, "'"));
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
