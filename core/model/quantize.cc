#include "core/model/quantize.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/json.h"

namespace spikeserve {
namespace {

constexpr float kLargestThreshold = 16384.0f;  // of a neuron whose weights are all small

// Returns max over j of |w_kj| / 127.
float RowScale(const Tensor& weight, int k) {
  float largest = 0.0f;
  for (int j = 0; j < weight.shape[1]; ++j) largest = std::max(largest, std::abs(weight.at(k, j)));
  return largest / static_cast<float>(kLargestInt8Weight);
}

// Returns the weights divided by the scale of their row. The limit matters only if the scale is
// subnormal and therefore inexact.
Int8Tensor RoundWeights(const Tensor& weight, const Tensor& scale) {
  Int8Tensor rounded = Int8Tensor::Zeros(weight.shape);
  const auto inputs = static_cast<size_t>(weight.shape[1]);
  constexpr auto kLimit = static_cast<float>(kLargestInt8Weight);
  for (size_t i = 0; i < weight.values.size(); ++i) {
    const float level = std::nearbyint(weight.values[i] / scale.values[i / inputs]);
    rounded.values[i] = static_cast<int8_t>(std::clamp(level, -kLimit, kLimit));
  }
  return rounded;
}

// Sets `rounded` to `value` / `scale`, rounded. INVALID_ARGUMENT if it does not fit 16 bits.
absl::Status RoundTo16Bits(const std::string& name, int k, float value, float scale,
                           int16_t* rounded) {
  const float level = std::nearbyint(value / scale);
  if (!(std::abs(level) <= std::numeric_limits<int16_t>::max())) {
    return absl::InvalidArgumentError(absl::StrCat("tensor ", Quoted(name),
                                                   ": expected at most 32767 units of ", scale,
                                                   ", received ", value, " at index ", k));
  }
  *rounded = static_cast<int16_t>(level);
  return absl::OkStatus();
}

absl::Status RoundPopulation(const std::string& name, const Linear& linear, float threshold,
                             IntegerPopulation* population) {
  const int outputs = linear.weight.shape[0];
  population->scale = Tensor::Zeros({outputs});
  population->bias = Int16Tensor::Zeros({outputs});
  population->threshold = Int16Tensor::Zeros({outputs});
  for (int k = 0; k < outputs; ++k) {
    const float scale = std::max(RowScale(linear.weight, k), threshold / kLargestThreshold);
    population->scale.values[k] = scale;
    absl::Status status =
        RoundTo16Bits(name + ".bias", k, linear.bias.values[k], scale, &population->bias.values[k]);
    status.Update(
        RoundTo16Bits(name + ".threshold", k, threshold, scale, &population->threshold.values[k]));
    if (!status.ok()) return status;
    population->threshold.values[k] = std::max<int16_t>(population->threshold.values[k], 1);
  }
  population->weight = RoundWeights(linear.weight, population->scale);
  return absl::OkStatus();
}

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
  if (absl::Status status = policy.Validate(); !status.ok()) return status;
  if (policy.config.arithmetic != Arithmetic::kFloat32) {
    return absl::InvalidArgumentError("arithmetic: expected float32, received int8");
  }
  Policy integer = policy;
  integer.config.arithmetic = Arithmetic::kInt8;
  if (absl::Status status = integer.config.Validate(); !status.ok()) return status;
  for (size_t i = 0; i < integer.weights.layers.size(); ++i) {
    absl::Status status = RoundLayer(absl::StrCat("layers.", i), integer.config.threshold,
                                     &integer.weights.layers[i]);
    if (!status.ok()) return status;
  }
  if (absl::Status status = integer.Validate(); !status.ok()) return status;
  return integer;
}

}  // namespace spikeserve
