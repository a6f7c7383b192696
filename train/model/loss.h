// The loss of training: imitation of the recorded actions, and a penalty on firing rates.
#pragma once

#include <torch/types.h>

#include <vector>

#include "core/action/action_space.h"
#include "train/model/torch_model.h"

namespace spikeserve {

// Returns the mean loss of the steps, weighted by `weights` [B, n], which are 0 after the end of an
// episode. The loss of a step is the cross-entropy of softmax(z) and the one-hot `targets` for a
// Discrete space, or for a Box the mean over its elements of the squared difference of tanh(z) and
// `targets` in [-1, 1], divided by the square of the element's `spread` [act]. So it does not
// depend on how wide the bounds are: with the deviations of the targets it is the share of their
// variance that is not explained. Logits z and targets are [B, n, act].
torch::Tensor ImitationLoss(const ActionSpace& space, const torch::Tensor& logits,
                            const torch::Tensor& targets, const torch::Tensor& weights,
                            const torch::Tensor& spread);

// Firing rates, in spikes per neuron and tick, above which a population is penalised. 1 means no
// penalty.
struct RateTargets {
  double hidden = 1.0;   // coder, query, key, value, ffn_in, ffn_hidden of every layer
  double readout = 1.0;  // the readout coder
};

// Returns the sum of max(0, rate - target) over all populations, which are the stages of each
// layer. Rates are means over the steps with `mask` [B, n] 1. Each population has a hinge of its
// own, because a penalty on the common rate silences query, key and value first. Phase spikes are
// not penalised: there are at most H of them per timestep and tick. Returns an undefined tensor if
// no population exceeds its target.
torch::Tensor RateHinge(const std::vector<Population>& populations, const RateTargets& targets,
                        const torch::Tensor& mask);

// Returns the share of all possible synaptic operations that the spikes cause, in [0, 1]: each
// spike is weighted by the number of synapses that it meets (a coder's by 3 d for queries, keys and
// values, the FFN coder's by the FFN size, a hidden neuron's by d, a query's, key's or value's by
// the 3 N tokens of the window). Unlike a hinge on rates, it favours the populations whose silence
// saves most. Returns an undefined tensor if there is no population (mode dense).
torch::Tensor OperationShare(const std::vector<Population>& populations, const ModelConfig& config,
                             const torch::Tensor& mask);

}  // namespace spikeserve
