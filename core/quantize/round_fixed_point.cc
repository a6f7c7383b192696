#include "core/quantize/round_fixed_point.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "absl/strings/str_cat.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/model/integer_weights.h"

namespace spikeserve {
namespace {

constexpr int kLargestFraction = 12;
// The largest standardised input for which the sums of an embedding must not saturate.
constexpr double kUsualInput = 4.0;

absl::Status RangeError(const std::string& name, double bound, double received, size_t index) {
  return InvalidArgument(absl::StrCat("tensor ", Quoted(name)),
                         absl::StrCat("at most ", bound, " in integer arithmetic"),
                         absl::StrCat(received, " at index ", index));
}

// Returns the exponent p for which |largest| * 2^p rounds to 64 ... 127.
int ExponentOf(double largest) {
  int exponent = 0;
  std::frexp(largest, &exponent);  // largest = f * 2^exponent with 0.5 <= f < 1
  const int p = 7 - exponent;
  return std::nearbyint(std::ldexp(largest, p)) > kLargestInt8Weight ? p - 1 : p;
}

constexpr float kLargestThreshold = 16384.0f;  // of a neuron whose weights are all small

// Sets `rounded` to `value` / `scale`, rounded. INVALID_ARGUMENT if it does not fit 16 bits.
absl::Status RoundTo16Bits(const std::string& name, int k, float value, float scale,
                           int16_t* rounded) {
  const float level = std::nearbyint(value / scale);
  if (!(std::abs(level) <= std::numeric_limits<int16_t>::max())) {
    return InvalidArgument(absl::StrCat("tensor ", Quoted(name)),
                           absl::StrCat("at most 32767 units of ", scale),
                           absl::StrCat(value, " at index ", k));
  }
  *rounded = static_cast<int16_t>(level);
  return absl::OkStatus();
}

// Returns max over j of |w_kj| / 127.
float RowScale(const Tensor& weight, int k) {
  float largest = 0.0f;
  for (int j = 0; j < weight.shape[1]; ++j) largest = std::max(largest, std::abs(weight.at(k, j)));
  return largest / static_cast<float>(kLargestInt8Weight);
}

// Returns the weights divided by the scale of their row and rounded, ties to even. The limit
// matters only if the scale is subnormal and therefore inexact.
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

}  // namespace

int FractionFor(double largest) {
  int fraction = kLargestFraction;
  while (fraction > 1 && largest * std::ldexp(1.0, fraction) > kLargestResidual) --fraction;
  return fraction;
}

double LargestEmbedded(const Linear& linear) {
  double largest = 0.0;
  for (int k = 0; k < linear.weight.shape[0]; ++k) {
    double sum = std::abs(linear.bias.values[k]);
    for (int j = 0; j < linear.weight.shape[1]; ++j) {
      sum += kUsualInput * std::abs(linear.weight.at(k, j));
    }
    largest = std::max(largest, sum);
  }
  return largest;
}

absl::Status RoundNumbers(const std::string& name, const Tensor& values, int fraction,
                          Int16Tensor* rounded) {
  *rounded = Int16Tensor::Zeros(values.shape);
  for (size_t i = 0; i < values.values.size(); ++i) {
    const double level = std::nearbyint(std::ldexp(double{values.values[i]}, fraction));
    if (std::abs(level) > kLargestResidual) {
      return RangeError(name, std::ldexp(kLargestResidual, -fraction), values.values[i], i);
    }
    rounded->values[i] = static_cast<int16_t>(level);
  }
  return absl::OkStatus();
}

absl::Status RoundMap(const std::string& name, const Linear& linear, double factor,
                      int input_fraction, int output_fraction, FixedPointMap* map) {
  const int outputs = linear.weight.shape[0];
  const int inputs = linear.weight.shape[1];
  map->weight = Int8Tensor::Zeros(linear.weight.shape);
  map->shift = Int8Tensor::Zeros({outputs});
  for (int k = 0; k < outputs; ++k) {
    double largest = 0.0;
    for (int j = 0; j < inputs; ++j) {
      largest = std::max(largest, std::abs(factor * linear.weight.at(k, j)));
    }
    if (largest == 0.0) continue;
    const int offset = input_fraction - output_fraction;
    const int exponent = std::min(ExponentOf(largest), 31 - offset);
    if (exponent + offset < -15) {
      return RangeError(name + ".weight", std::ldexp(127.0, 15 + offset), largest, k);
    }
    map->shift.values[k] = static_cast<int8_t>(exponent + offset);
    for (int j = 0; j < inputs; ++j) {
      const double level = std::nearbyint(std::ldexp(factor * linear.weight.at(k, j), exponent));
      map->weight.values[static_cast<size_t>(k) * inputs + j] = static_cast<int8_t>(level);
    }
  }
  return RoundNumbers(name + ".bias", linear.bias, output_fraction, &map->bias);
}

absl::Status RoundNorm(const std::string& name, const Norm& norm, int fraction,
                       FixedPointNorm* rounded) {
  const double root = std::sqrt(static_cast<double>(norm.weight.values.size()));
  // Normalised numbers have 15 fraction bits.
  const double unit = root * std::ldexp(1.0, fraction - 15);
  double largest = 0.0;
  for (const float weight : norm.weight.values) {
    largest = std::max(largest, std::abs(weight * unit));
  }
  int shift = 15;
  while (shift > 0 && std::nearbyint(std::ldexp(largest, shift)) > kLargestResidual) --shift;
  rounded->shift = Int8Tensor::Zeros({1});
  rounded->shift.values[0] = static_cast<int8_t>(shift);
  rounded->weight = Int16Tensor::Zeros(norm.weight.shape);
  for (size_t i = 0; i < norm.weight.values.size(); ++i) {
    const double level = std::nearbyint(std::ldexp(norm.weight.values[i] * unit, shift));
    if (std::abs(level) > kLargestResidual) {
      return RangeError(name + ".weight", kLargestResidual / unit, norm.weight.values[i], i);
    }
    rounded->weight.values[i] = static_cast<int16_t>(level);
  }
  return RoundNumbers(name + ".bias", norm.bias, fraction, &rounded->bias);
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
