#include "train/trainer/activity_router.h"

#include "absl/strings/str_cat.h"
#include "core/math/vector_view.h"

namespace spikeserve {

absl::Status RouteByActivity(Policy* policy) {
  const ModelConfig& config = policy->config;
  if (!config.has_routing()) {
    return absl::InvalidArgumentError(
        absl::StrCat("--activity_router: expected --mode=route or full, received ",
                     std::string(ToString(config.mode))));
  }
  if (config.routing_hidden_size != config.heads) {
    return absl::InvalidArgumentError(
        absl::StrCat("--activity_router: expected --routing_hidden_size=", config.heads,
                     ", the number of heads, received ", config.routing_hidden_size));
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
