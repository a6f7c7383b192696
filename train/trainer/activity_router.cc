#include "train/trainer/activity_router.h"

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/math/vector_view.h"

namespace spikeserve {

absl::Status RouteByActivity(Policy* policy) {
  const ModelConfig& config = policy->config;
  if (!config.has_routing()) {
    return InvalidArgument("--activity_router", "--mode=route or full",
                           std::string(ToString(config.mode)));
  }
  if (config.routing_hidden_size != config.heads) {
    return InvalidArgument(
        "--activity_router",
        absl::StrCat("--routing_hidden_size=", config.heads, ", the number of heads"),
        config.routing_hidden_size);
  }
  const int size = config.head_size();
  for (LayerWeights& layer : policy->weights.layers) {
    auto weight = AsMatrix(layer.routing_hidden.weight.values, config.heads);
    weight.setZero();
    for (int head = 0; head < config.heads; ++head) {
      weight.row(head).segment(head * size, size).setConstant(1.0f / static_cast<float>(size));
    }
    AsVector(layer.routing_hidden.bias.values).setZero();
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
