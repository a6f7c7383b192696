#include "core/engine/dense/integer_dense_pass.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdlib>
#include <numbers>
#include <utility>

#include "core/engine/counting.h"
#include "core/engine/fixed_point_maps.h"
#include "core/engine/token_costs.h"
#include "core/math/exp.h"
#include "core/math/fixed_point.h"

namespace spikeserve {
namespace {

// Fraction bits of the factor by which a score becomes octaves.
constexpr int kScoreFraction = 10;
// Fraction bits of octaves.
constexpr int kOctaveFraction = 8;
constexpr int kLargestWeight = 255;
constexpr int kLargestActivation = 127;

// The activation is max(x, 0) minus an even function, which a table holds in steps of 1/32 up to 4.
constexpr int kTableFraction = 5;
constexpr int kTableSize = 128;

int32_t TableEntry(int index, int fraction) {
  constexpr float kSqrtTwoOverPi = 0.7978845608028654f;
  const float x = std::ldexp(static_cast<float>(index), -kTableFraction);
  const float gelu = 0.5f * x * (1.0f + Tanh(kSqrtTwoOverPi * (x + 0.044715f * x * x * x)));
  return static_cast<int32_t>(std::nearbyint(std::ldexp(x - gelu, fraction)));
}

int32_t Gelu(int32_t x, int fraction) {
  const int64_t index = RoundShift(std::abs(int64_t{x}), fraction - kTableFraction);
  const int32_t smaller = index < kTableSize ? TableEntry(static_cast<int>(index), fraction) : 0;
  return std::max(x, 0) - smaller;
}

Block RoundToBlock(std::vector<int32_t> x) {
  uint32_t largest = 0;
  for (const int32_t value : x) largest = std::max(largest, static_cast<uint32_t>(std::abs(value)));
  const int exponent = std::max(static_cast<int>(std::bit_width(largest)) - 7, 0);
  for (int32_t& value : x) {
    value = std::clamp(static_cast<int32_t>(RoundShift(value, exponent)), -kLargestActivation,
                       kLargestActivation);
  }
  return {std::move(x), exponent};
}

int ScoreScale(int head_size) {
  const double scale = std::numbers::log2e / std::sqrt(static_cast<double>(head_size));
  return static_cast<int>(std::nearbyint(std::ldexp(scale, kScoreFraction)));
}

}  // namespace

IntegerDensePass::IntegerDensePass(const Policy& policy, std::vector<KeyValues>& layers)
    : policy_(policy),
      config_(policy.config),
      scale_(ScoreScale(policy.config.head_size())),
      layers_(layers) {}

std::vector<float> IntegerDensePass::Run(const Token& token, Trace* trace) {
  counts_.weight_bytes += SharedWeightBytes(
      config_, token.kind, static_cast<int>(token.input.size()), policy_.action_space.size());
  Integers x = Embed(token);
  for (int i = 0; i < config_.layers; ++i) {
    const FixedPointLayer& layer = policy_.weights.layers[i].fixed_point;
    const Block input = RoundToBlock(x);
    Store(layers_[i], token, layer, input);
    if (i + 1 == config_.layers && token.kind != TokenKind::kState) return {};
    const Integers merged = Attend(SplitHeads(Map(layer.query, input)), layers_[i],
                                   trace == nullptr ? nullptr : &trace->layers[i]);
    const Integers update = Map(layer.attention_output, RoundToBlock(merged));
    for (size_t k = 0; k < x.size(); ++k) x[k] += update[k];
    Normalize(layer.attention_norm, x);
    FeedForward(layer, x);
  }
  std::vector<float> readout;
  for (const int32_t value : x) {
    readout.push_back(std::ldexp(static_cast<float>(value), -config_.residual_fraction));
  }
  return readout;
}

void IntegerDensePass::CountHead(const std::vector<float>& readout) {
  counts_.multiply_accumulates += CountProducts(policy_.weights.head, readout);
}

IntegerDensePass::Integers IntegerDensePass::Embed(const Token& token) {
  const FixedPointEnds& ends = policy_.weights.fixed_point;
  const FixedPointEmbedding& embedding = EmbeddingOf(ends, token.kind);
  Integers input;
  for (const float value : token.input) {
    const float scaled = std::ldexp(value, config_.input_fraction);
    input.push_back(static_cast<int32_t>(
        std::nearbyint(std::clamp<float>(scaled, -kLargestResidual, kLargestResidual))));
  }
  const uint64_t products = CountProducts(embedding.linear, input);
  counts_.multiply_accumulates += products;
  counts_.integer_multiply_accumulates += products;
  counts_.wide_multiply_accumulates += products;
  Integers x = ApplyMap(embedding.linear, input);
  const Int16Tensor& timesteps = ends.embed_timestep;
  const int row = static_cast<int>(std::min<int64_t>(token.timestep, timesteps.shape[0] - 1));
  for (size_t k = 0; k < x.size(); ++k) x[k] += timesteps.at(row, static_cast<int>(k));
  Normalize(embedding.norm, x);
  return x;
}

IntegerDensePass::Integers IntegerDensePass::Map(const FixedPointMap& map, const Block& input) {
  const uint64_t products = CountProducts(map, input.values);
  counts_.multiply_accumulates += products;
  counts_.integer_multiply_accumulates += products;
  Integers output = ApplyMap(map, input.values, input.exponent);
  for (int32_t& value : output) value = SaturateResidual(value);
  return output;
}

std::vector<Block> IntegerDensePass::SplitHeads(const Integers& x) const {
  std::vector<Block> heads;
  for (auto first = x.begin(); first != x.end(); first += config_.head_size()) {
    heads.push_back(RoundToBlock(Integers(first, first + config_.head_size())));
  }
  return heads;
}

void IntegerDensePass::Store(KeyValues& tokens, const Token& token, const FixedPointLayer& layer,
                             const Block& input) {
  const int64_t forgotten = token.timestep - config_.context;
  while (!tokens.empty() && tokens.front().token.timestep <= forgotten) tokens.pop_front();
  tokens.push_back({{token.kind, token.timestep},
                    SplitHeads(Map(layer.key, input)),
                    SplitHeads(Map(layer.value, input))});
  counts_.attention_bytes += 2 * static_cast<uint64_t>(config_.hidden_size);
}

IntegerDensePass::Integers IntegerDensePass::WeighKeys(const Block& query, const KeyValues& tokens,
                                                       int head) {
  std::vector<int64_t> octaves;
  for (const KeyValue& seen : tokens) {
    const Block& key = seen.keys[head];
    int32_t dot = 0;
    for (size_t k = 0; k < query.values.size(); ++k) {
      dot += query.values[k] * key.values[k];
      counts_.attention_products += query.values[k] != 0 && key.values[k] != 0;
    }
    const int shift = 2 * config_.residual_fraction + kScoreFraction - kOctaveFraction -
                      query.exponent - key.exponent;
    octaves.push_back(RoundShift(int64_t{dot} * scale_, shift));
  }
  counts_.softmax_terms += octaves.size();
  const int64_t best = *std::max_element(octaves.begin(), octaves.end());
  Integers weights;
  for (const int64_t octave : octaves) {
    weights.push_back(std::min(kLargestWeight, PowerOfTwo(best - octave) >> 8));
  }
  return weights;
}

IntegerDensePass::Integers IntegerDensePass::Attend(const std::vector<Block>& query,
                                                    const KeyValues& tokens, LayerTrace* trace) {
  if (trace != nullptr) {
    for (const KeyValue& seen : tokens) trace->keys.push_back(seen.token);
  }
  Integers merged;
  for (int head = 0; head < config_.heads; ++head) {
    const Integers weights = WeighKeys(query[head], tokens, head);
    int64_t total = 0;
    for (const int32_t weight : weights) total += weight;
    std::vector<int64_t> sums(config_.head_size(), 0);
    for (size_t j = 0; j < tokens.size(); ++j) {
      const Block& value = tokens[j].values[head];
      for (size_t k = 0; k < sums.size(); ++k) {
        sums[k] += int64_t{weights[j]} * value.values[k] * (1 << value.exponent);
        counts_.attention_products += weights[j] != 0 && value.values[k] != 0;
      }
      if (trace != nullptr) {
        trace->attention.push_back(static_cast<float>(weights[j]) / static_cast<float>(total));
      }
    }
    for (const int64_t sum : sums) {
      merged.push_back(SaturateResidual(RoundDivide(sum, total)));
      counts_.attention_scalings += sum != 0;
    }
  }
  counts_.attention_bytes += 2 * tokens.size() * static_cast<uint64_t>(config_.hidden_size);
  return merged;
}

void IntegerDensePass::FeedForward(const FixedPointLayer& layer, Integers& x) {
  Integers hidden = Map(layer.ffn_hidden, RoundToBlock(x));
  for (int32_t& h : hidden) h = Gelu(h, config_.residual_fraction);
  const Integers update = Map(layer.ffn_output, RoundToBlock(hidden));
  for (size_t k = 0; k < x.size(); ++k) x[k] += update[k];
  Normalize(layer.ffn_norm, x);
}

void IntegerDensePass::Normalize(const FixedPointNorm& norm, Integers& x) {
  counts_.layer_norm_elements += x.size();
  NormalizeResidual(norm, x);
}

}  // namespace spikeserve
