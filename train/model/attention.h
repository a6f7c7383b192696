// Attention over a band of past tokens, and dendritic routing of its heads, on torch tensors. Pure
// functions.
//
// Symbols: B clips, S tokens per clip, Q query tokens, H heads, d hidden size, d_h = d/H, T ticks.
#pragma once

#include <torch/types.h>

#include "core/model/config.h"
#include "train/model/parameters.h"

namespace spikeserve {

// Returns the mask that is added to the attention scores of a clip, [3 timesteps, 3 timesteps].
// Element (i, j) is 0 if token i may attend to token j, which is the case if j <= i and j's
// timestep is one of the last `context` timesteps up to i's; otherwise it is a large negative
// number.
torch::Tensor BandMask(int64_t timesteps, int context, torch::Device device);

// Computes y = softmax(scale q k^T + mask) v for every head and leading dimension: q [..., Q, d], k
// and v [..., S, d], mask [Q, S], scale [H] or [1]. Returns [..., H, Q, d_h].
torch::Tensor Attend(const torch::Tensor& q, const torch::Tensor& k, const torch::Tensor& v,
                     const torch::Tensor& scale, const torch::Tensor& mask, int heads);

// Computes mean_t yhat(t) (eq. 4.8 to 4.11): multiplies the heads of y [T, B, H, Q, d_h] by their
// gates at every tick, sums or concatenates them, and averages over the ticks. Returns [B, Q,
// merged_size]. `layer` is the prefix of the layer's tensor names.
torch::Tensor RouteHeads(const Parameters& parameters, const std::string& layer,
                         const ModelConfig& config, const torch::Tensor& y);

}  // namespace spikeserve
