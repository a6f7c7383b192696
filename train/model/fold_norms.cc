#include "train/model/fold_norms.h"

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

// A smaller weight would leave nothing of the stream that can be divided by it.
constexpr double kSmallestWeight = 1e-6;

// What the stream without norms is multiplied by to give the one with norms, [d].
using Scale = std::vector<double>;

void ScaleRow(double factor, int k, Tensor* weight) {
  const int inputs = weight->shape[1];
  float* const row = weight->values.data() + static_cast<size_t>(k) * inputs;
  for (int j = 0; j < inputs; ++j) row[j] = static_cast<float>(factor * row[j]);
}

void FoldEmbedding(Embedding* embedding) {
  const Norm norm = std::exchange(embedding->norm, {});
  for (size_t k = 0; k < norm.weight.values.size(); ++k) {
    const double weight = norm.weight.values[k];
    float& bias = embedding->linear.bias.values[k];
    ScaleRow(weight, static_cast<int>(k), &embedding->linear.weight);
    bias = static_cast<float>(weight * bias + norm.bias.values[k]);
  }
}

// With x = scale * z, weight * (x + update) + bias is (weight * scale) * (z + update / scale + bias
// / (weight * scale)).
void FoldUpdate(Norm folded, Linear* update, Scale* scale) {
  for (size_t k = 0; k < scale->size(); ++k) {
    const double weight = folded.weight.values[k];
    const double next =
        (*scale)[k] * std::copysign(std::max(std::abs(weight), kSmallestWeight), weight);
    float& bias = update->bias.values[k];
    ScaleRow(1.0 / (*scale)[k], static_cast<int>(k), &update->weight);
    bias = static_cast<float>(bias / (*scale)[k] + folded.bias.values[k] / next);
    (*scale)[k] = next;
  }
}

void FoldCoder(const Scale& scale, Coder* coder) {
  for (size_t k = 0; k < scale.size(); ++k) {
    coder->gain.values[k] = static_cast<float>(scale[k] * coder->gain.values[k]);
  }
}

}  // namespace

void FoldNorms(Policy* policy) {
  SPIKESERVE_DCHECK(policy->config.has_norms() && !policy->config.is_dense());
  Weights& weights = policy->weights;
  FoldEmbedding(&weights.embed_return);
  FoldEmbedding(&weights.embed_state);
  FoldEmbedding(&weights.embed_action);
  Scale scale(policy->config.hidden_size, 1.0);
  for (LayerWeights& layer : weights.layers) {
    FoldCoder(scale, &layer.coder);
    FoldUpdate(std::exchange(layer.attention_norm, {}), &layer.attention_output, &scale);
    FoldCoder(scale, &layer.ffn_coder);
    FoldUpdate(std::exchange(layer.ffn_norm, {}), &layer.ffn_output, &scale);
  }
  FoldCoder(scale, &weights.readout_coder);
  policy->config.norm = NormKind::kNone;
}

}  // namespace spikeserve
