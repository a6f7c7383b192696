// Computes the spike-driven maps of a layer in naive loops, in both arithmetics.
//
// All functions are pure and thread-safe. Symbols: T ticks, H heads, d hidden size, R coder spikes,
// P phase spikes.
#ifndef CORE_ENGINE_REFERENCE_POPULATIONS_H_
#define CORE_ENGINE_REFERENCE_POPULATIONS_H_

#include <vector>

#include "core/engine/trace.h"
#include "core/math/tensor.h"
#include "core/model/config.h"
#include "core/model/integer_weights.h"

namespace spikeserve {

// The coder spikes of one token. Neurons whose weights are added together form a group: neurons of
// equal period for the rate coder, neurons that fire at the same tick for the Bernoulli coder,
// which has no periods.
struct CodedToken {
  bool periodic = false;  // true for the rate coder
  // [T]: the neurons of period n, or those that fire at tick n, for n = 1 ... T; ascending.
  std::vector<std::vector<int>> groups;
  SpikeTrain spikes;  // [T][d]
};

// Returns W x + b. Starts with the bias and adds the products in ascending order of the input.
std::vector<float> Affine(const Linear& linear, const std::vector<float>& input);

// Returns the spike count of a neuron divided by T.
float Rate(const SpikeTrain& train, int neuron);

// Returns LIF(W [R || P] + b), [T][out], where `phase` is [T][H], or [T][0] without phase spikes.
// In float32, a current is summed in the canonical order: the bias; then, for each period n that
// divides the tick, ascending, the sum over the neurons of that period, ascending; then the phase
// spikes by head. In integers, every order gives the same sum.
SpikeTrain Fire(const ModelConfig& config, const Linear& linear, const CodedToken& coded,
                const SpikeTrain& phase);
SpikeTrain Fire(const ModelConfig& config, const IntegerPopulation& population,
                const CodedToken& coded, const SpikeTrain& phase);

// Returns W (spike count / T) + b for the spikes of the hidden population, [T][F]: [d].
std::vector<float> MapCounts(const Linear& linear, const SpikeTrain& hidden);
std::vector<float> MapCounts(const IntegerOutput& output, const SpikeTrain& hidden);

}  // namespace spikeserve

#endif  // CORE_ENGINE_REFERENCE_POPULATIONS_H_
