// Defines the populations of a layer in integer arithmetic (Arithmetic::kInteger).
//
// Weights are 8-bit integers in units of a scale, one scale per output neuron; currents, membranes
// and thresholds are 16-bit integers in the same units (see core/neuron/shift_lif.h). Sums are
// exact, so the order of addition does not matter. Symbols as in weights.h. Plain values.
#pragma once

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/math/tensor.h"

namespace spikeserve {

// The largest magnitude of an 8-bit weight. -128 is not used, so that the range is symmetric.
inline constexpr int kLargestInt8Weight = 127;
// The largest magnitude that |bias| + sum over the inputs of |weight| may have for one neuron. No
// current can then leave 16 bits, in any order of addition.
inline constexpr int kLargestCurrent = 32767;

// A population of integer LIF neurons and its synapses.
struct IntegerPopulation {
  Int8Tensor weight;      // [out, in], in units of scale; -127 to 127
  Tensor scale;           // [out], > 0: the float32 weight is weight * scale
  Int16Tensor bias;       // [out], in units of scale
  Int16Tensor threshold;  // [out], in units of scale; at least 1
};

// The populations of one layer.
struct IntegerMaps {
  IntegerPopulation query;       // [d, in], [d]
  IntegerPopulation key;         // [d, in], [d]
  IntegerPopulation value;       // [d, in], [d]
  IntegerPopulation ffn_hidden;  // [F, d], [F]
};

// Returns INVALID_ARGUMENT "tensor T: expected E, received R at index I".
absl::Status ElementError(absl::string_view tensor, absl::string_view expected,
                          const absl::AlphaNum& received, size_t index);

// Returns INVALID_ARGUMENT if a number of layer `name` ("layers.0") is out of its range, or if the
// magnitudes of a neuron's bias and weights add up to more than kLargestCurrent. The message names
// the tensor. REQUIRES: the tensors have the shapes of TensorSlots.
absl::Status CheckIntegerMaps(absl::string_view name, const IntegerMaps& maps);

}  // namespace spikeserve
