// LIF neurons as one autograd function over all ticks, several times faster than a graph node for
// each tick.
//
// Deterministic, whatever the number of threads.
#ifndef TRAIN_MODEL_LIF_FUNCTION_H_
#define TRAIN_MODEL_LIF_FUNCTION_H_

#include <torch/types.h>

#include "core/neuron/lif.h"
#include "train/model/surrogate.h"

namespace spikeserve {

struct LifOptions {
  Lif neuron;
  int ticks = 10;  // T
  Surrogate surrogate;
};

// Spikes [T, ...] of neurons under a constant current [...]: the rate coder.
torch::Tensor LifConstant(const torch::Tensor& current, const LifOptions& options);

// Spikes [T, ...] of neurons under a current per tick [T, ...].
torch::Tensor LifPerTick(const torch::Tensor& current, const LifOptions& options);

}  // namespace spikeserve

#endif  // TRAIN_MODEL_LIF_FUNCTION_H_
