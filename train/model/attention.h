// Attention over a band of past tokens, and dendritic routing of its heads, on torch tensors.
//
// Symbols: B clips, S tokens of a clip, Q query tokens, H heads, d hidden size, d_h = d/H, T ticks.
#ifndef TRAIN_MODEL_ATTENTION_H_
#define TRAIN_MODEL_ATTENTION_H_

#include <torch/types.h>

#include "core/model/config.h"
#include "train/model/parameters.h"

namespace spikeserve {

// What is added to the scores of a clip of `timesteps` timesteps: 0 where token i may see key j (j
// <= i, and j's timestep among the last `context` of i's), a large negative number elsewhere. [3
// timesteps, 3 timesteps].
torch::Tensor BandMask(int64_t timesteps, int context);

// y = softmax(scale q k^T + mask) v for every head and leading dimension: q [..., Q, d], k and v
// [..., S, d], mask [Q, S], scale [H] or [1]. Returns [..., H, Q, d_h].
torch::Tensor Attend(const torch::Tensor& q, const torch::Tensor& k, const torch::Tensor& v,
                     const torch::Tensor& scale, const torch::Tensor& mask, int heads);

// mean_t yhat(t) (eq. 4.8 to 4.11): gates the heads of y [T, B, H, Q, d_h] at every tick, sums them
// or puts them side by side, and averages over ticks. Returns [B, Q, merged_size]. `layer` is the
// prefix of the layer's tensors.
torch::Tensor RouteHeads(const Parameters& parameters, const std::string& layer,
                         const ModelConfig& config, const torch::Tensor& y);

}  // namespace spikeserve

#endif  // TRAIN_MODEL_ATTENTION_H_
