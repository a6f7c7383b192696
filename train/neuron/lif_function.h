// LIF neurons as one autograd function over all ticks, which is several times faster than one graph
// node per tick.
//
// The results do not depend on the number of threads.
#pragma once

#include <torch/types.h>

#include "core/neuron/lif.h"
#include "core/neuron/shift_lif.h"
#include "train/neuron/surrogate.h"

namespace spikeserve {

struct LifOptions {
  Lif neuron;
  int ticks = 10;  // T
  Surrogate surrogate;
};

// Returns the spikes [T, ...] of neurons with a constant input current [...]: the rate coder.
torch::Tensor LifConstant(const torch::Tensor& current, const LifOptions& options);

// Returns the spikes [T, ...] of neurons with an input current per tick [T, ...].
torch::Tensor LifPerTick(const torch::Tensor& current, const LifOptions& options);

// Integer neurons. The last dimension of their currents is a population, whose neurons have a
// threshold and a scale each: float32 tensors of its size, the thresholds integers.
struct IntegerLifOptions {
  ShiftLif neuron;
  torch::Tensor threshold;  // in units of scale
  torch::Tensor scale;
  int ticks = 10;  // T
  Surrogate surrogate;
  torch::Tensor bias;    // in units of scale; the currents include it
  torch::Tensor events;  // for each tick and token [T, ...] whether an input fires
};

// As LifPerTick, for integer neurons and currents in units of the scale: integers of 16 bits,
// stored as float32. The backward pass takes the rounding of the membrane for the identity.
torch::Tensor IntegerLifPerTick(const torch::Tensor& current, const IntegerLifOptions& options);

}  // namespace spikeserve
