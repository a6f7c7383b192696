// The SNN-DT of integer arithmetic, for training: the forward pass is exactly that of the engines,
// the backward pass takes every rounding for the identity ("straight through", see
// rounded_maps.h) and uses surrogate gradients for the spikes.
//
// Each number is computed twice: as integers, and in float32 from the float parameters, from which
// the gradient comes.
#pragma once

#include "core/model/policy.h"
#include "train/model/clip_tensors.h"
#include "train/model/parameters.h"
#include "train/model/rounded_maps.h"
#include "train/neuron/lif_function.h"

namespace spikeserve {

// Runs the policy `rounded`, which is QuantizeToInteger() of a policy with the values of
// `parameters`, on all clips. `maps` are those of `rounded`, `coder` the neurons of the policy's
// coders before it was rounded, and the surrogate of all neurons. Thread-safe as long as nothing
// changes the tensors. REQUIRES: not dense, attention by tick.
ModelOutput ForwardInIntegers(const Policy& rounded, const RoundedMaps& maps,
                              const Parameters& parameters, const LifOptions& coder,
                              const ClipTensors& clips);

}  // namespace spikeserve
