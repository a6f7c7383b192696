// The parts of integer arithmetic on torch tensors of integers, exactly as docs/design/integer.md
// defines them, for the forward pass of training.
//
// Integers are float64 and have no gradient. No sum leaves the integers that float64 holds exactly.
// Symbols: B clips, S tokens of a clip, Q tokens with a query, d hidden size, H heads, d_h = d / H,
// T ticks. All functions are pure and thread-safe.
#pragma once

#include <torch/types.h>

#include <algorithm>
#include <vector>

#include "core/math/tensor.h"
#include "core/model/config.h"
#include "core/model/fixed_point_weights.h"

namespace spikeserve {

// Returns the numbers as float64.
template <class Number>
torch::Tensor Numbers(const BasicTensor<Number>& tensor) {
  const std::vector<int64_t> shape(tensor.shape.begin(), tensor.shape.end());
  torch::Tensor copy = torch::empty(shape, torch::kDouble);
  std::copy(tensor.values.begin(), tensor.values.end(), copy.template data_ptr<double>());
  return copy;
}

// Returns the integers of inputs with `fraction` fraction bits, halves to even, limited to 16 bits.
torch::Tensor RoundInputs(const torch::Tensor& inputs, int fraction);

// Returns the map of x [..., in]: [..., out].
torch::Tensor ApplyMap(const FixedPointMap& map, const torch::Tensor& x);

// Returns the norm of x [..., d].
torch::Tensor Normalize(const FixedPointNorm& norm, const torch::Tensor& x);

// Returns the spikes (0 or 1, float32) of a coder for x [..., d]: [T, ..., d].
torch::Tensor CodeSpikes(const PeriodCoder& coder, const torch::Tensor& x);

// Spikes, 0 or 1, and which tokens see each other.
struct HeadInputs {
  torch::Tensor query;  // [T, B, Q, d]
  torch::Tensor key;    // [T, B, S, d]
  torch::Tensor value;  // [T, B, S, d]
  torch::Tensor band;   // whether a token attends to another, bool: [Q, S]
};

// Returns y with kGateFraction fraction bits: [T, B, H, Q, d_h], equal at all ticks at which the
// query does not fire. REQUIRES: attention by tick.
torch::Tensor AttendInIntegers(const HeadInputs& inputs, const Int16Tensor& scale,
                               const ModelConfig& config);

// Returns the merged heads of y [T, B, H, Q, d_h], with kGateFraction fraction bits: [B, Q,
// merged_size].
torch::Tensor MergeInIntegers(const FixedPointLayer& layer, const ModelConfig& config,
                              const torch::Tensor& y);

}  // namespace spikeserve
