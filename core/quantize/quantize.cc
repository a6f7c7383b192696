#include "core/quantize/quantize.h"

#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "core/quantize/round_population.h"

namespace spikeserve {
namespace {

void RoundOutput(Linear linear, IntegerOutput* output) {
  const int outputs = linear.weight.shape[0];
  output->scale = Tensor::Zeros({outputs});
  for (int k = 0; k < outputs; ++k) {
    const float scale = RowScale(linear.weight, k);
    output->scale.values[k] = scale > 0.0f ? scale : 1.0f;
  }
  output->weight = RoundWeights(linear.weight, output->scale);
  output->bias = std::move(linear.bias);
}

// Moves the spike-driven maps of a layer to integers and clears the float32 ones.
absl::Status RoundLayer(const std::string& name, float threshold, LayerWeights* layer) {
  const auto round = [&](const char* population, Linear& linear, IntegerPopulation* integer) {
    return RoundPopulation(absl::StrCat(name, population), std::exchange(linear, {}), threshold,
                           integer);
  };
  absl::Status status = round(".attention.query", layer->query, &layer->integer.query);
  status.Update(round(".attention.key", layer->key, &layer->integer.key));
  status.Update(round(".attention.value", layer->value, &layer->integer.value));
  status.Update(round(".ffn.hidden", layer->ffn_hidden, &layer->integer.ffn_hidden));
  RoundOutput(std::exchange(layer->ffn_output, {}), &layer->integer.ffn_output);
  return status;
}

}  // namespace

absl::StatusOr<Policy> Quantize(const Policy& policy) {
  RETURN_IF_ERROR(policy.Validate());
  if (policy.config.arithmetic != Arithmetic::kFloat32) {
    return absl::InvalidArgumentError("arithmetic: expected float32, received int8");
  }
  Policy integer = policy;
  integer.config.arithmetic = Arithmetic::kInt8;
  RETURN_IF_ERROR(integer.config.Validate());
  for (size_t i = 0; i < integer.weights.layers.size(); ++i) {
    RETURN_IF_ERROR(RoundLayer(absl::StrCat("layers.", i), integer.config.threshold,
                               &integer.weights.layers[i]));
  }
  RETURN_IF_ERROR(integer.Validate());
  return integer;
}

}  // namespace spikeserve
