#include "train/model/lif_kernels.h"

#include <algorithm>
#include <vector>

// Compiles one clone per vector extension; the dynamic loader selects one.
#define SPIKESERVE_VECTOR_CLONES __attribute__((target_clones("avx512f", "avx2", "default")))

namespace spikeserve {
namespace {

// Number of neurons processed at a time, so that their state over all ticks stays in the L1 cache.
constexpr int64_t kBlock = 512;

// Computes the membranes before the reset, membranes[tick * kBlock + i], of `size` neurons from
// `begin` on.
inline __attribute__((always_inline)) void Membranes(const LifRange& range, int64_t begin,
                                                     int64_t size, TickRows current,
                                                     float* membranes) {
  const float decay = range.neuron.decay;
  const float threshold = range.neuron.threshold;
  float kept[kBlock] = {};  // membranes after the reset
  for (int tick = 0; tick < range.ticks; ++tick) {
    const float* input = current.data + tick * current.tick_stride + begin;
    float* row = membranes + tick * kBlock;
    for (int64_t i = 0; i < size; ++i) {
      const float v = decay * kept[i] + input[i];
      row[i] = v;
      kept[i] = v >= threshold ? 0.0f : v;
    }
  }
}

template <typename Derivative>
inline __attribute__((always_inline)) void BackwardBlock(
    const LifRange& range, int64_t begin, int64_t size, TickRows current, TickRows spike_gradient,
    const float* membranes, Derivative derivative, float* current_gradient) {
  const float decay = range.neuron.decay;
  const float threshold = range.neuron.threshold;
  float later[kBlock] = {};  // decay dL/dV of the following tick
  float sum[kBlock] = {};
  for (int tick = range.ticks - 1; tick >= 0; --tick) {
    const float* gradient = spike_gradient.data + tick * spike_gradient.tick_stride + begin;
    const float* row = membranes + tick * kBlock;
    for (int64_t i = 0; i < size; ++i) {
      const float u = row[i] - threshold;
      const float g = gradient[i] * derivative(u) + (u >= 0.0f ? 0.0f : later[i]);
      later[i] = decay * g;
      sum[i] = g + (current.tick_stride == 0 ? sum[i] : 0.0f);
    }
    std::copy_n(sum, size, current_gradient + tick * current.tick_stride + begin);
  }
}

}  // namespace

SPIKESERVE_VECTOR_CLONES
void LifForward(const LifRange& range, TickRows current, float* spikes, int64_t spike_stride) {
  const float decay = range.neuron.decay;
  const float threshold = range.neuron.threshold;
  for (int64_t begin = range.begin; begin < range.end; begin += kBlock) {
    const int64_t size = std::min(kBlock, range.end - begin);
    float kept[kBlock] = {};
    for (int tick = 0; tick < range.ticks; ++tick) {
      const float* input = current.data + tick * current.tick_stride + begin;
      float* output = spikes + tick * spike_stride + begin;
      for (int64_t i = 0; i < size; ++i) {
        const float v = decay * kept[i] + input[i];
        output[i] = v >= threshold ? 1.0f : 0.0f;
        kept[i] = v >= threshold ? 0.0f : v;
      }
    }
  }
}

SPIKESERVE_VECTOR_CLONES
void LifBackward(const LifRange& range, const Surrogate& surrogate, TickRows current,
                 TickRows spike_gradient, float* current_gradient) {
  std::vector<float> membranes(range.ticks * kBlock);
  for (int64_t begin = range.begin; begin < range.end; begin += kBlock) {
    const int64_t size = std::min(kBlock, range.end - begin);
    Membranes(range, begin, size, current, membranes.data());
    WithDerivative(
        surrogate, [&](auto derivative) __attribute__((always_inline)) {
          BackwardBlock(range, begin, size, current, spike_gradient, membranes.data(), derivative,
                        current_gradient);
        });
  }
}

}  // namespace spikeserve
