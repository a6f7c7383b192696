// What training minimises: imitation of the recorded actions, and silence.
#ifndef TRAIN_MODEL_LOSS_H_
#define TRAIN_MODEL_LOSS_H_

#include <torch/types.h>

#include <vector>

#include "core/action/action_space.h"
#include "train/model/torch_model.h"

namespace spikeserve {

// Mean over the steps, weighted by `weights` [B, n], 0 where there is no step, of: the
// cross-entropy of softmax(z) against the one-hot `targets` (Discrete), or the mean squared
// distance of tanh(z) from `targets` in [-1, 1] (Box). Logits and targets are [B, n, act].
torch::Tensor ImitationLoss(const ActionSpace& space, const torch::Tensor& logits,
                            const torch::Tensor& targets, const torch::Tensor& weights);

// Above which firing rate (spikes per neuron and tick) a population is pushed down. 1 leaves it
// alone.
struct RateTargets {
  double hidden = 1.0;   // coder, query, key, value, ffn_in, ffn_hidden of every layer
  double readout = 1.0;  // the readout coder
};

// The sum over populations, each stage of each layer on its own, of max(0, rate - target), with
// rates over the steps with mask [B, n] 1. A hinge for each, because a penalty on their common rate
// silences query, key and value first. Phase spikes, which cost H of them at most, are left alone.
// Undefined where no population is above its target.
torch::Tensor RateHinge(const std::vector<Population>& populations, const RateTargets& targets,
                        const torch::Tensor& mask);

}  // namespace spikeserve

#endif  // TRAIN_MODEL_LOSS_H_
