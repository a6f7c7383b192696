// Computes the spike-driven maps of a layer in float32, in naive loops.
//
// All functions are pure and thread-safe. Symbols: T ticks, H heads, d hidden size, R coder spikes,
// P phase spikes.
#pragma once

#include <vector>

#include "core/engine/trace.h"
#include "core/math/tensor.h"
#include "core/model/config.h"

namespace spikeserve {

// The coder spikes of one token. The weights of neurons of equal period are added together.
struct CodedToken {
  std::vector<std::vector<int>> groups;  // [T]: the neurons of period n = 1 ... T; ascending
  SpikeTrain spikes;                     // [T][d]
};

// Returns W x + b. Starts with the bias and adds the products in ascending order of the input.
std::vector<float> Affine(const Linear& linear, const std::vector<float>& input);

// Returns the spike count of a neuron divided by T.
float Rate(const SpikeTrain& train, int neuron);

// Returns LIF(W [R || P] + b), [T][out], where `phase` is [T][H], or [T][0] without phase spikes.
// A current is summed in the canonical order: the bias; then, for each period n that divides the
// tick, ascending, the sum over the neurons of that period, ascending; then the phase spikes by
// head.
SpikeTrain Fire(const ModelConfig& config, const Linear& linear, const CodedToken& coded,
                const SpikeTrain& phase);

}  // namespace spikeserve
