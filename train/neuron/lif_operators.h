// The neurons of lif_kernels.h by operators of torch: for tensors that are not in the processor's
// memory, where plain loops cannot read them.
//
// Pure functions.
#pragma once

#include <torch/types.h>

#include "core/neuron/lif.h"
#include "train/neuron/surrogate.h"

namespace spikeserve {

// Returns ds/du for every element of u.
torch::Tensor SurrogateDerivative(const Surrogate& surrogate, const torch::Tensor& u);

// Returns the spikes [T, ...] of LifForward(). The current is [...] if it is `constant` over the
// ticks, otherwise [T, ...].
torch::Tensor LifForwardOperators(const Lif& neuron, int ticks, bool constant,
                                  const torch::Tensor& current);

// Returns the gradient of LifBackward() for the spikes' gradient [T, ...], in the shape of the
// current.
torch::Tensor LifBackwardOperators(const Lif& neuron, int ticks, bool constant,
                                   const Surrogate& surrogate, const torch::Tensor& current,
                                   const torch::Tensor& spike_gradient);

}  // namespace spikeserve
