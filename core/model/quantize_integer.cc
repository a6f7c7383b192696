#include "core/model/quantize_integer.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <numbers>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/json.h"
#include "core/model/round_population.h"
#include "core/neuron/period_table.h"

namespace spikeserve {
namespace {

constexpr int kLargestFraction = 12;
// The largest standardised input for which the sums of an embedding must not saturate.
constexpr double kUsualInput = 4.0;
// Room that the residual stream keeps for updates before they are normed.
constexpr double kResidualRoom = 1.25;

// Returns the largest number of fraction bits with which `largest` fits a residual.
int FractionFor(double largest, int limit = kLargestFraction) {
  int fraction = limit;
  while (fraction > 1 && largest * std::ldexp(1.0, fraction) > kLargestResidual) --fraction;
  return fraction;
}

// Returns the shift n, 1 to 8, whose leak 2^-n is nearest to `leak` on a logarithmic scale.
int NearestShift(double leak) {
  int exponent = 0;
  const double significand = std::frexp(leak, &exponent);  // 0.5 to 1, squared 0.5 half way
  return std::clamp(significand * significand < 0.5 ? 1 - exponent : -exponent, 1, 8);
}

absl::Status RangeError(const std::string& name, double bound, double received, size_t index) {
  return absl::InvalidArgumentError(absl::StrCat("tensor ", Quoted(name), ": expected at most ",
                                                 bound, " in integer arithmetic, received ",
                                                 received, " at index ", index));
}

// Sets `rounded` to the values with `fraction` fraction bits.
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

// Returns the exponent p for which |largest| * 2^p rounds to 64 ... 127.
int ExponentOf(double largest) {
  int exponent = 0;
  std::frexp(largest, &exponent);  // largest = f * 2^exponent with 0.5 <= f < 1
  const int p = 7 - exponent;
  return std::nearbyint(std::ldexp(largest, p)) > kLargestInt8Weight ? p - 1 : p;
}

// Rounds a map whose inputs and outputs have the given fraction bits. Weights are first multiplied
// by `factor`.
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
  Tensor bias = linear.bias;
  return RoundNumbers(name + ".bias", bias, output_fraction, &map->bias);
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

// Tabulates the periods of a coder. The neuron fires within n ticks if its current reaches
// thresholds[n - 1], so if sign * x exceeds the largest number for which it does not.
PeriodCoder TabulateCoder(const Coder& coder, const std::vector<float>& thresholds, int fraction) {
  const auto size = static_cast<int>(coder.gain.values.size());
  const auto ticks = static_cast<int>(thresholds.size());
  PeriodCoder table = {Int8Tensor::Zeros({size}), Int16Tensor::Zeros({size, ticks})};
  for (int j = 0; j < size; ++j) {
    const double gain = coder.gain.values[j];
    const double bias = coder.bias.values[j];
    table.sign.values[j] = gain < 0.0 ? -1 : 1;
    for (int n = 0; n < ticks; ++n) {
      double last_silent = bias >= thresholds[n] ? -32768.0 : 32767.0;
      if (gain != 0.0) {
        const double smallest = (thresholds[n] - bias) / std::abs(gain);
        last_silent =
            std::clamp(std::ceil(std::ldexp(smallest, fraction)) - 1.0, -32768.0, 32767.0);
      }
      table.threshold.values[static_cast<size_t>(j) * ticks + n] =
          static_cast<int16_t>(last_silent);
    }
  }
  return table;
}

// Rounds the parts of one policy.
class Rounding {
 public:
  Rounding(const Policy& policy, const ModelConfig& config)
      : policy_(policy),
        config_(config),
        periods_({policy.config.membrane_decay, policy.config.threshold}, policy.config.ticks) {}

  absl::Status Run(Policy* integer) {
    FixedPointEnds& ends = integer->weights.fixed_point;
    const Weights& weights = policy_.weights;
    absl::Status status = RoundEmbedding("embed.return", weights.embed_return, &ends.embed_return);
    status.Update(RoundEmbedding("embed.state", weights.embed_state, &ends.embed_state));
    status.Update(RoundEmbedding("embed.action", weights.embed_action, &ends.embed_action));
    for (size_t i = 0; i < weights.layers.size() && status.ok(); ++i) {
      integer->weights.layers[i] = {};
      status =
          RoundLayer(absl::StrCat("layers.", i), weights.layers[i], &integer->weights.layers[i]);
    }
    ends.readout_coder = Tabulate(weights.readout_coder);
    return status;
  }

 private:
  PeriodCoder Tabulate(const Coder& coder) const {
    return TabulateCoder(coder, periods_.thresholds(), config_.residual_fraction);
  }

  absl::Status RoundEmbedding(const std::string& name, const Embedding& embedding,
                              FixedPointEmbedding* rounded) const {
    const Tensor& weight = embedding.linear.weight;
    double largest = 0.0;
    for (int k = 0; k < weight.shape[0]; ++k) {
      double sum = std::abs(embedding.linear.bias.values[k]);
      for (int j = 0; j < weight.shape[1]; ++j) sum += kUsualInput * std::abs(weight.at(k, j));
      largest = std::max(largest, sum);
    }
    // The norm that follows cancels the scale of the output.
    absl::Status status = RoundMap(name, embedding.linear, 1.0, config_.input_fraction,
                                   FractionFor(largest), &rounded->linear);
    status.Update(
        RoundNorm(name + ".norm", embedding.norm, config_.residual_fraction, &rounded->norm));
    return status;
  }

  // Rounds a population, without the inputs that the new mode does not have.
  absl::Status RoundSpiking(const std::string& name, const Linear& linear, int inputs,
                            IntegerPopulation* population) const {
    Linear cropped = {Tensor::Zeros({linear.weight.shape[0], inputs}), linear.bias};
    for (int k = 0; k < linear.weight.shape[0]; ++k) {
      for (int j = 0; j < inputs; ++j) {
        cropped.weight.values[static_cast<size_t>(k) * inputs + j] = linear.weight.at(k, j);
      }
    }
    return RoundPopulation(name, cropped, config_.threshold, population);
  }

  absl::Status RoundLayer(const std::string& name, const LayerWeights& layer,
                          LayerWeights* rounded) const {
    const int inputs = config_.attention_inputs();
    const std::string attention = name + ".attention";
    IntegerMaps& maps = rounded->integer;
    FixedPointLayer& fixed = rounded->fixed_point;
    const int residual = config_.residual_fraction;
    absl::Status status = RoundSpiking(attention + ".query", layer.query, inputs, &maps.query);
    status.Update(RoundSpiking(attention + ".key", layer.key, inputs, &maps.key));
    status.Update(RoundSpiking(attention + ".value", layer.value, inputs, &maps.value));
    status.Update(RoundSpiking(name + ".ffn.hidden", layer.ffn_hidden, config_.hidden_size,
                               &maps.ffn_hidden));
    status.Update(RoundScales(attention + ".scale", layer.scale, &fixed.attention_scale));
    if (config_.has_routing()) {
      status.Update(RoundMap(name + ".routing.hidden", layer.routing_hidden, 1.0, kGateFraction,
                             kGateFraction, &fixed.routing_hidden));
      // Scores count octaves instead of multiples of e.
      Linear gate = layer.routing_gate;
      for (float& bias : gate.bias.values) bias *= std::numbers::log2e_v<float>;
      status.Update(RoundMap(name + ".routing.gate", gate, std::numbers::log2e, kGateFraction,
                             kGateFraction, &fixed.routing_gate));
    }
    status.Update(RoundMap(attention + ".output", layer.attention_output, 1.0, kGateFraction,
                           residual, &fixed.attention_output));
    status.Update(
        RoundNorm(attention + ".norm", layer.attention_norm, residual, &fixed.attention_norm));
    // The inputs of ffn.output are spike counts, and the weights those of firing rates.
    status.Update(RoundMap(name + ".ffn.output", layer.ffn_output, 1.0 / config_.ticks, 0, residual,
                           &fixed.ffn_output));
    status.Update(RoundNorm(name + ".ffn.norm", layer.ffn_norm, residual, &fixed.ffn_norm));
    fixed.coder = Tabulate(layer.coder);
    fixed.ffn_coder = Tabulate(layer.ffn_coder);
    return status;
  }

  // A row of attention sums the overlaps of all ticks, so the scale is that of their mean.
  absl::Status RoundScales(const std::string& name, const Tensor& scale,
                           Int16Tensor* rounded) const {
    Tensor octaves = scale;
    for (float& value : octaves.values) {
      value = static_cast<float>(value * std::numbers::log2e / config_.ticks);
    }
    return RoundNumbers(name, octaves, kScaleFraction, rounded);
  }

  const Policy& policy_;
  const ModelConfig& config_;
  const PeriodTable periods_;
};

// Returns the fraction bits with which no output of a norm can saturate.
int ResidualFraction(const Policy& policy) {
  const double root = std::sqrt(static_cast<double>(policy.config.hidden_size));
  double largest = 0.0;
  const auto visit = [&](const Norm& norm) {
    for (size_t k = 0; k < norm.weight.values.size(); ++k) {
      largest = std::max(
          largest, std::abs(norm.weight.values[k]) * root + std::abs(double{norm.bias.values[k]}));
    }
  };
  visit(policy.weights.embed_return.norm);
  visit(policy.weights.embed_state.norm);
  visit(policy.weights.embed_action.norm);
  for (const LayerWeights& layer : policy.weights.layers) {
    visit(layer.attention_norm);
    visit(layer.ffn_norm);
  }
  return FractionFor(kResidualRoom * largest);
}

// Returns the configuration of the result.
absl::StatusOr<ModelConfig> ConfigOf(const Policy& policy, const IntegerOptions& options) {
  ModelConfig config = policy.config;
  config.arithmetic = Arithmetic::kInteger;
  config.mode = options.mode.value_or(config.mode);
  if ((config.has_phase() && !policy.config.has_phase()) ||
      (config.has_routing() && !policy.config.has_routing()) || config.is_dense()) {
    return absl::InvalidArgumentError(absl::StrCat(
        "mode: expected one whose parts mode ", std::string(ToString(policy.config.mode)),
        " has, received ", std::string(ToString(config.mode))));
  }
  config.attention = options.attention;
  config.leak =
      options.leak.value_or(config.membrane_decay < 511.0f / 512.0f ? Leak::kShift : Leak::kNone);
  const double leak = std::max(1.0 - double{config.membrane_decay}, 1.0 / 256.0);
  const int shift = NearestShift(leak);
  config.membrane_decay = config.leak == Leak::kNone ? 1.0f : 1.0f - std::ldexp(1.0f, -shift);
  config.input_fraction = FractionFor(options.largest_input);
  config.residual_fraction = ResidualFraction(policy);
  return config;
}

}  // namespace

absl::StatusOr<Policy> QuantizeToInteger(const Policy& policy, const IntegerOptions& options) {
  if (absl::Status status = policy.Validate(); !status.ok()) return status;
  if (policy.config.arithmetic != Arithmetic::kFloat32) {
    return absl::InvalidArgumentError(
        absl::StrCat("arithmetic: expected float32, received ",
                     std::string(ToString(policy.config.arithmetic))));
  }
  const absl::StatusOr<ModelConfig> config = ConfigOf(policy, options);
  if (!config.ok()) return config.status();
  if (absl::Status status = config->Validate(); !status.ok()) return status;
  Policy integer = policy;
  integer.config = *config;
  integer.weights.embed_return = {};
  integer.weights.embed_state = {};
  integer.weights.embed_action = {};
  integer.weights.readout_coder = {};
  if (!config->has_phase()) integer.weights.phase_omega = integer.weights.phase_phi = {};
  if (absl::Status status = Rounding(policy, *config).Run(&integer); !status.ok()) return status;
  if (absl::Status status = integer.Validate(); !status.ok()) return status;
  return integer;
}

}  // namespace spikeserve
