// Rounds the float32 maps of a policy to 8-bit weights with a scale for each output neuron.
//
// All functions are pure and thread-safe.
#pragma once

#include <string>

#include "absl/status/status.h"
#include "core/math/tensor.h"
#include "core/model/integer_weights.h"

namespace spikeserve {

// Returns max over j of |w_kj| / 127.
float RowScale(const Tensor& weight, int k);

// Returns the weights divided by the scale of their row and rounded, ties to even.
Int8Tensor RoundWeights(const Tensor& weight, const Tensor& scale);

// Rounds the map `linear` into a population (see Quantize). INVALID_ARGUMENT if 16 bits cannot hold
// a bias or threshold. The message names the tensor, of which `name` is the prefix.
absl::Status RoundPopulation(const std::string& name, const Linear& linear, float threshold,
                             IntegerPopulation* population);

}  // namespace spikeserve
