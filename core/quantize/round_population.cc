#include "core/quantize/round_population.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "absl/strings/str_cat.h"
#include "core/base/json.h"

namespace spikeserve {
namespace {

constexpr float kLargestThreshold = 16384.0f;  // of a neuron whose weights are all small

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

}  // namespace

float RowScale(const Tensor& weight, int k) {
  float largest = 0.0f;
  for (int j = 0; j < weight.shape[1]; ++j) largest = std::max(largest, std::abs(weight.at(k, j)));
  return largest / static_cast<float>(kLargestInt8Weight);
}

// The limit matters only if the scale is subnormal and therefore inexact.
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

}  // namespace spikeserve
