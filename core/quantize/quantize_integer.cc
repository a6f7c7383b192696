#include "core/quantize/quantize_integer.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <numbers>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/neuron/period_table.h"
#include "core/quantize/round_fixed_point.h"

namespace spikeserve {
namespace {

// Room that the residual stream keeps for updates before they are normed.
constexpr double kResidualRoom = 1.25;

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
    // A norm that follows cancels the scale of the output.
    const int fraction = config_.has_norms() ? FractionFor(LargestEmbedded(embedding.linear))
                                             : config_.residual_fraction;
    absl::Status status =
        RoundMap(name, embedding.linear, 1.0, config_.input_fraction, fraction, &rounded->linear);
    status.Update(RoundAnyNorm(name + ".norm", embedding.norm, &rounded->norm));
    return status;
  }

  // Rounds a norm, unless the policy has none.
  absl::Status RoundAnyNorm(const std::string& name, const Norm& norm,
                            FixedPointNorm* rounded) const {
    if (!config_.has_norms()) return absl::OkStatus();
    return RoundNorm(name, norm, config_.residual_fraction, rounded);
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
    status.Update(RoundScores(attention + ".scale", layer.scale, &fixed.attention_scale));
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
    status.Update(RoundAnyNorm(attention + ".norm", layer.attention_norm, &fixed.attention_norm));
    // The inputs of ffn.output are spike counts, and the weights those of firing rates.
    status.Update(RoundMap(name + ".ffn.output", layer.ffn_output, 1.0 / config_.ticks, 0, residual,
                           &fixed.ffn_output));
    status.Update(RoundAnyNorm(name + ".ffn.norm", layer.ffn_norm, &fixed.ffn_norm));
    fixed.coder = Tabulate(layer.coder);
    fixed.ffn_coder = Tabulate(layer.ffn_coder);
    return status;
  }

  // Rounds scores to octaves.
  static absl::Status RoundScores(const std::string& name, const Tensor& scores,
                                  Int16Tensor* rounded) {
    Tensor octaves = scores;
    for (float& value : octaves.values) value = static_cast<float>(value * std::numbers::log2e);
    return RoundNumbers(name, octaves, kScaleFraction, rounded);
  }

  const Policy& policy_;
  const ModelConfig& config_;
  const PeriodTable periods_;
};

// Returns the largest magnitude of a bias that is added to the residual stream.
double LargestBias(const Weights& weights) {
  double largest = 0.0;
  const auto visit = [&largest](const Linear& map) {
    for (const float bias : map.bias.values) largest = std::max(largest, std::abs(double{bias}));
  };
  visit(weights.embed_return.linear);
  visit(weights.embed_state.linear);
  visit(weights.embed_action.linear);
  for (const LayerWeights& layer : weights.layers) {
    visit(layer.attention_output);
    visit(layer.ffn_output);
  }
  return largest;
}

// Returns the fraction bits with which no output of a norm can saturate, or, without norms, neither
// `largest_residual` nor a bias.
int ResidualFraction(const Policy& policy, double largest_residual) {
  if (!policy.config.has_norms()) {
    return FractionFor(std::max(kResidualRoom * largest_residual, LargestBias(policy.weights)));
  }
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
      (config.has_routing() && !policy.config.has_routing()) ||
      config.is_dense() != policy.config.is_dense()) {
    return InvalidArgument(
        "mode",
        absl::StrCat("one whose parts mode ", std::string(ToString(policy.config.mode)), " has"),
        std::string(ToString(config.mode)));
  }
  const float leak = std::round((1.0f - config.membrane_decay) * 256.0f);
  config.membrane_decay = 1.0f - std::clamp(leak, 1.0f, 128.0f) / 256.0f;
  if (config.is_dense()) config.attention = AttentionTicks::kAllTicks;  // there are no ticks
  config.input_fraction = FractionFor(options.largest_input);
  config.residual_fraction = ResidualFraction(policy, options.largest_residual);
  return config;
}

// Returns the fraction bits that the sums of all embeddings have in common, because the same
// timesteps are added to each.
int EmbeddingFraction(const Weights& weights) {
  double timestep = 0.0;
  for (const float value : weights.embed_timestep.values) {
    timestep = std::max(timestep, double{std::abs(value)});
  }
  const double largest = std::max({LargestEmbedded(weights.embed_return.linear),
                                   LargestEmbedded(weights.embed_state.linear),
                                   LargestEmbedded(weights.embed_action.linear)});
  return FractionFor(largest + timestep);
}

absl::Status RoundEnds(const Weights& weights, const ModelConfig& config, FixedPointEnds* ends) {
  const int fraction = EmbeddingFraction(weights);
  const auto round = [&](const std::string& name, const Embedding& embedding,
                         FixedPointEmbedding* rounded) {
    absl::Status status =
        RoundMap(name, embedding.linear, 1.0, config.input_fraction, fraction, &rounded->linear);
    status.Update(
        RoundNorm(name + ".norm", embedding.norm, config.residual_fraction, &rounded->norm));
    return status;
  };
  absl::Status status = round("embed.return", weights.embed_return, &ends->embed_return);
  status.Update(round("embed.state", weights.embed_state, &ends->embed_state));
  status.Update(round("embed.action", weights.embed_action, &ends->embed_action));
  status.Update(RoundNumbers("embed.timestep.weight", weights.embed_timestep, fraction,
                             &ends->embed_timestep));
  return status;
}

absl::Status RoundLayer(const std::string& name, const LayerWeights& layer, int fraction,
                        FixedPointLayer* rounded) {
  const auto round = [&](const char* part, const Linear& linear, FixedPointMap* map) {
    return RoundMap(absl::StrCat(name, part), linear, 1.0, fraction, fraction, map);
  };
  absl::Status status = round(".attention.query", layer.query, &rounded->query);
  status.Update(round(".attention.key", layer.key, &rounded->key));
  status.Update(round(".attention.value", layer.value, &rounded->value));
  status.Update(round(".attention.output", layer.attention_output, &rounded->attention_output));
  status.Update(round(".ffn.hidden", layer.ffn_hidden, &rounded->ffn_hidden));
  status.Update(round(".ffn.output", layer.ffn_output, &rounded->ffn_output));
  status.Update(RoundNorm(name + ".attention.norm", layer.attention_norm, fraction,
                          &rounded->attention_norm));
  status.Update(RoundNorm(name + ".ffn.norm", layer.ffn_norm, fraction, &rounded->ffn_norm));
  return status;
}

// Sets the integers of `integer`, a dense policy, to those of `policy`.
absl::Status RoundDensePolicy(const Policy& policy, Policy* integer) {
  const ModelConfig& config = integer->config;
  absl::Status status = RoundEnds(policy.weights, config, &integer->weights.fixed_point);
  integer->weights.embed_timestep = {};
  for (size_t i = 0; i < policy.weights.layers.size() && status.ok(); ++i) {
    LayerWeights& layer = integer->weights.layers[i];
    layer = {};
    status = RoundLayer(absl::StrCat("layers.", i), policy.weights.layers[i],
                        config.residual_fraction, &layer.fixed_point);
  }
  return status;
}

}  // namespace

absl::StatusOr<Policy> QuantizeToInteger(const Policy& policy, const IntegerOptions& options) {
  RETURN_IF_ERROR(policy.Validate());
  if (policy.config.arithmetic != Arithmetic::kFloat32) {
    return InvalidArgument("arithmetic", "float32",
                           std::string(ToString(policy.config.arithmetic)));
  }
  ASSIGN_OR_RETURN(const ModelConfig config, ConfigOf(policy, options));
  RETURN_IF_ERROR(config.Validate());
  Policy integer = policy;
  integer.config = config;
  integer.weights.embed_return = {};
  integer.weights.embed_state = {};
  integer.weights.embed_action = {};
  integer.weights.readout_coder = {};
  if (!config.has_phase()) integer.weights.phase_omega = integer.weights.phase_phi = {};
  RETURN_IF_ERROR(config.is_dense() ? RoundDensePolicy(policy, &integer)
                                    : Rounding(policy, config).Run(&integer));
  RETURN_IF_ERROR(integer.Validate());
  return integer;
}

}  // namespace spikeserve
