// The Bernoulli coder (the paper's alternative to the rate coder) with a straight-through gradient.
#ifndef TRAIN_NEURON_BERNOULLI_FUNCTION_H_
#define TRAIN_NEURON_BERNOULLI_FUNCTION_H_

#include <torch/types.h>

namespace spikeserve {

// Identifies the random draws of a batch: one stream per clip, and the position of each token in
// it. Equals the keys that the engines use.
struct BernoulliDraws {
  torch::Tensor seeds;      // [B], int64
  torch::Tensor timesteps;  // [B, tokens], int64
  std::vector<int> kinds;   // [tokens], 0 return-to-go, 1 state, 2 action
  int site = 0;             // see BernoulliKey::site
};

// Returns spikes [T, B, tokens, d], each 1 with probability sigmoid(x), for x [B, tokens, d]. The
// backward pass uses 1 as the derivative of a spike with respect to its probability.
torch::Tensor BernoulliSpikes(const torch::Tensor& x, const BernoulliDraws& draws, int ticks);

}  // namespace spikeserve

#endif  // TRAIN_NEURON_BERNOULLI_FUNCTION_H_
