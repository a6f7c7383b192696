// Phase-shifted positional spikes (eq. 4.4) with a surrogate gradient for omega and phi.
#pragma once

#include <torch/types.h>

#include "train/neuron/surrogate.h"

namespace spikeserve {

// Returns the spikes 1[sin(omega_k tau + phi_k) > 0], float [..., H], of H generators with omega
// and phi [H] at times tau [..., 1] (double). The backward pass uses the surrogate at u = sin(.).
// It divides the gradient of omega by max(1, largest |tau|), because that gradient grows with the
// time in the episode while the gradient of phi does not.
torch::Tensor PhaseSpikes(const torch::Tensor& omega, const torch::Tensor& phi,
                          const torch::Tensor& tau, const Surrogate& surrogate);

}  // namespace spikeserve
