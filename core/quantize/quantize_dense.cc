#include "core/quantize/quantize_dense.h"

#include <algorithm>
#include <cmath>
#include <string>

#include "absl/strings/str_cat.h"
#include "core/quantize/round_fixed_point.h"

namespace spikeserve {
namespace {

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

}  // namespace

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

}  // namespace spikeserve
