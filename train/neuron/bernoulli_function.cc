#include "train/neuron/bernoulli_function.h"

#include "core/neuron/coder.h"

namespace spikeserve {

torch::Tensor BernoulliSpikes(const torch::Tensor& x, const BernoulliDraws& draws, int ticks) {
  const torch::Tensor input = x.detach().contiguous();
  const torch::Tensor timesteps = draws.timesteps.contiguous();
  const int64_t clips = x.size(0), tokens = x.size(1), neurons = x.size(2);
  torch::Tensor spikes = torch::empty({ticks, clips, tokens, neurons});
  float* out = spikes.data_ptr<float>();
  for (int tick = 0; tick < ticks; ++tick) {
    for (int64_t row = 0; row < clips * tokens; ++row) {
      const BernoulliKey key = {
          .seed = static_cast<uint64_t>(draws.seeds.data_ptr<int64_t>()[row / tokens]),
          .timestep = timesteps.data_ptr<int64_t>()[row],
          .token = draws.kinds[row % tokens],
          .site = draws.site};
      const float* in = input.data_ptr<float>() + row * neurons;
      for (int64_t i = 0; i < neurons; ++i) {
        *out++ = BernoulliSpike(key, static_cast<int>(i), tick, in[i], 1.0f, 0.0f) ? 1.0f : 0.0f;
      }
    }
  }
  // Straight-through estimator: the value is the draw, the gradient is that of the probability.
  const torch::Tensor probability = torch::sigmoid(x);
  return spikes + (probability - probability.detach());
}

}  // namespace spikeserve
