#include "train/neuron/lif_kernels.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

// Compiles one clone per vector extension of x86-64; the dynamic loader selects one. Every arm64
// processor has the vectors that the compiler uses there.
#ifdef __x86_64__
#define SPIKESERVE_VECTOR_CLONES __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define SPIKESERVE_VECTOR_CLONES
#endif

namespace spikeserve {
namespace {

// Number of neurons processed at a time, so that their state over all ticks stays in the L1 cache.
constexpr int64_t kBlock = 512;

// Computes the distances u = V - V_th of the membranes before the reset, distances[tick * kBlock +
// i], of `size` neurons from `begin` on. The neuron fires where u >= 0.
inline __attribute__((always_inline)) void Distances(const LifRange& range, int64_t begin,
                                                     int64_t size, TickRows current,
                                                     float* distances) {
  const float decay = range.neuron.decay;
  const float threshold = range.neuron.threshold;
  float kept[kBlock] = {};  // membranes after the reset
  for (int tick = 0; tick < range.ticks; ++tick) {
    const float* input = current.data + tick * current.tick_stride + begin;
    float* row = distances + tick * kBlock;
    for (int64_t i = 0; i < size; ++i) {
      const float v = decay * kept[i] + input[i];
      row[i] = v - threshold;
      kept[i] = v >= threshold ? 0.0f : v;
    }
  }
}

// The thresholds and scales of the neurons of a block.
struct IntegerBlock {
  int32_t threshold[kBlock];
  float scale[kBlock];

  IntegerBlock(const IntegerLifRange& range, int64_t begin, int64_t size) {
    int64_t k = begin % range.width;
    for (int64_t i = 0; i < size; ++i) {
      threshold[i] = static_cast<int32_t>(range.threshold[k]);
      scale[i] = range.scale[k];
      if (++k == range.width) k = 0;
    }
  }
};

// The distance of a neuron that cannot fire at a tick. No surrogate has a gradient there.
constexpr float kCannotFire = -1e9f;

int32_t Saturate(int32_t value) {
  using Limits = std::numeric_limits<int16_t>;
  return std::clamp<int32_t>(value, Limits::min(), Limits::max());
}

// The membranes of a block of integer neurons.
struct ShiftedMembranes {
  ShiftLif neuron;
  TickRows events;
  int32_t bias[kBlock];
  int32_t token[kBlock];  // index of the neuron's event

  ShiftedMembranes(const IntegerLifRange& range, int64_t begin, int64_t size)
      : neuron(range.neuron), events(range.events) {
    for (int64_t i = 0; i < size; ++i) {
      bias[i] = static_cast<int32_t>(range.bias[(begin + i) % range.width]);
      token[i] = static_cast<int32_t>((begin + i) / range.width);
    }
  }

  // Advances the membrane of neuron i of the block to the end of a tick, as ShiftLif::Leak() and
  // ShiftLif::Charge(), but without the reset. Returns whether the neuron may fire at that tick.
  bool Charge(int tick, int64_t i, float current, int32_t& membrane) const {
    const bool event = events.data[tick * events.tick_stride + token[i]] != 0.0f;
    auto leaked = static_cast<int16_t>(membrane);
    neuron.Leak(static_cast<int16_t>(bias[i]), leaked);
    membrane = event ? Saturate(leaked + static_cast<int32_t>(current) - bias[i]) : leaked;
    return event;
  }
};

// As Distances, in units of the float32 policy: the integer distances times the scale.
inline __attribute__((always_inline)) void IntegerDistances(const IntegerLifRange& range,
                                                            int64_t begin, int64_t size,
                                                            TickRows current, float* distances) {
  const ShiftedMembranes membranes(range, begin, size);
  const IntegerBlock block(range, begin, size);
  int32_t kept[kBlock] = {};
  for (int tick = 0; tick < range.ticks; ++tick) {
    const float* input = current.data + tick * current.tick_stride + begin;
    float* row = distances + tick * kBlock;
    for (int64_t i = 0; i < size; ++i) {
      const bool may_fire = membranes.Charge(tick, i, input[i], kept[i]);
      const auto distance = static_cast<float>(kept[i] - block.threshold[i]);
      row[i] = may_fire ? block.scale[i] * distance : kCannotFire;
      kept[i] = row[i] >= 0.0f ? 0 : kept[i];
    }
  }
}

// Returns the factor by which a membrane decays.
float DecayOf(const IntegerLifRange& range) {
  return 1.0f - static_cast<float>(range.neuron.leak) / 256.0f;
}

// The rows of a backward pass over `size` neurons from `begin` on.
struct BackwardBlock {
  float decay;
  int ticks;
  int64_t begin;
  int64_t size;
  TickRows current;
  TickRows spike_gradient;
  const float* distances;
};

template <typename Derivative>
inline __attribute__((always_inline)) void Backward(const BackwardBlock& block,
                                                    Derivative derivative,
                                                    float* current_gradient) {
  float later[kBlock] = {};  // decay dL/dV of the following tick
  float sum[kBlock] = {};
  for (int tick = block.ticks - 1; tick >= 0; --tick) {
    const float* gradient =
        block.spike_gradient.data + tick * block.spike_gradient.tick_stride + block.begin;
    const float* row = block.distances + tick * kBlock;
    for (int64_t i = 0; i < block.size; ++i) {
      const float u = row[i];
      const float g = gradient[i] * derivative(u) + (u >= 0.0f ? 0.0f : later[i]);
      later[i] = block.decay * g;
      sum[i] = g + (block.current.tick_stride == 0 ? sum[i] : 0.0f);
    }
    std::copy_n(sum, block.size, current_gradient + tick * block.current.tick_stride + block.begin);
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
  std::vector<float> distances(range.ticks * kBlock);
  for (int64_t begin = range.begin; begin < range.end; begin += kBlock) {
    const int64_t size = std::min(kBlock, range.end - begin);
    Distances(range, begin, size, current, distances.data());
    const BackwardBlock block = {range.neuron.decay, range.ticks,     begin, size, current,
                                 spike_gradient,     distances.data()};
    WithDerivative(
        surrogate, [&](auto derivative) __attribute__((always_inline)) {
          Backward(block, derivative, current_gradient);
        });
  }
}

SPIKESERVE_VECTOR_CLONES
void IntegerLifForward(const IntegerLifRange& range, TickRows current, float* spikes,
                       int64_t spike_stride) {
  std::vector<float> distances(range.ticks * kBlock);
  for (int64_t begin = range.begin; begin < range.end; begin += kBlock) {
    const int64_t size = std::min(kBlock, range.end - begin);
    IntegerDistances(range, begin, size, current, distances.data());
    for (int tick = 0; tick < range.ticks; ++tick) {
      const float* row = distances.data() + tick * kBlock;
      float* output = spikes + tick * spike_stride + begin;
      for (int64_t i = 0; i < size; ++i) output[i] = row[i] >= 0.0f ? 1.0f : 0.0f;
    }
  }
}

SPIKESERVE_VECTOR_CLONES
void IntegerLifBackward(const IntegerLifRange& range, const Surrogate& surrogate, TickRows current,
                        TickRows spike_gradient, float* current_gradient) {
  std::vector<float> distances(range.ticks * kBlock);
  for (int64_t begin = range.begin; begin < range.end; begin += kBlock) {
    const int64_t size = std::min(kBlock, range.end - begin);
    IntegerDistances(range, begin, size, current, distances.data());
    const BackwardBlock block = {DecayOf(range), range.ticks,    begin,           size,
                                 current,        spike_gradient, distances.data()};
    WithDerivative(
        surrogate, [&](auto derivative) __attribute__((always_inline)) {
          Backward(block, derivative, current_gradient);
        });
    // The derivative with respect to a current in units of the scale.
    for (int tick = 0; tick < range.ticks; ++tick) {
      float* gradient = current_gradient + tick * current.tick_stride + begin;
      for (int64_t i = 0; i < size; ++i) {
        gradient[i] *= range.scale[(begin + i) % range.width];
      }
    }
  }
}

}  // namespace spikeserve
