// The Bernoulli coder (the paper's alternative to the rate coder) with a straight-through gradient.
#ifndef TRAIN_MODEL_BERNOULLI_FUNCTION_H_
#define TRAIN_MODEL_BERNOULLI_FUNCTION_H_

#include <torch/types.h>

namespace spikeserve {

// Which draws: one stream per clip, and the tokens' place in it.
struct BernoulliDraws {
  torch::Tensor seeds;      // [B], int64
  torch::Tensor timesteps;  // [B, tokens], int64
  std::vector<int> kinds;   // [tokens], 0 return-to-go, 1 state, 2 action
  int site = 0;             // as BernoulliKey::site
};

// Spikes [T, B, tokens, d], each 1 with probability sigmoid(x), for x [B, tokens, d]. In the
// backward pass a spike's derivative with respect to its probability is taken as 1.
torch::Tensor BernoulliSpikes(const torch::Tensor& x, const BernoulliDraws& draws, int ticks);

}  // namespace spikeserve

#endif  // TRAIN_MODEL_BERNOULLI_FUNCTION_H_
