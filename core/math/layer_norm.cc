#include "core/math/layer_norm.h"

#include <cmath>

namespace spikeserve {
namespace {

// Returns the sum of the partial sums, folded in halves. Overwrites `partial`.
float FoldLanes(float (&partial)[kSumLanes]) {
  for (int half = kSumLanes / 2; half > 0; half /= 2) {
    for (int lane = 0; lane < half; ++lane) partial[lane] += partial[lane + half];
  }
  return partial[0];
}

}  // namespace

float OrderedSum(const float* values, size_t size) {
  float partial[kSumLanes] = {};
  for (size_t i = 0; i < size; ++i) partial[i % kSumLanes] += values[i];
  return FoldLanes(partial);
}

void LayerNorm(const float* weight, const float* bias, float* x, size_t size) {
  const float mean = OrderedSum(x, size) / static_cast<float>(size);
  float squares[kSumLanes] = {};
  for (size_t i = 0; i < size; ++i) {
    x[i] -= mean;
    squares[i % kSumLanes] += x[i] * x[i];
  }
  const float variance = FoldLanes(squares) / static_cast<float>(size);
  const float inverse = 1.0f / std::sqrt(variance + kLayerNormEpsilon);
  for (size_t i = 0; i < size; ++i) x[i] = x[i] * inverse * weight[i] + bias[i];
}

}  // namespace spikeserve
