// LIF neurons over T ticks and their backward pass, as plain loops over arrays: the inner loops of
// training.
//
// Compiled once for each x86-64 vector extension and chosen when the program starts, so a binary
// runs everywhere; all variants give the same bits. Safe to call from many threads on disjoint
// ranges of neurons.
#ifndef TRAIN_MODEL_LIF_KERNELS_H_
#define TRAIN_MODEL_LIF_KERNELS_H_

#include <cstdint>

#include "core/neuron/lif.h"
#include "train/model/surrogate.h"

namespace spikeserve {

// A row of one value per neuron for every tick: element (tick, i) is data[tick * tick_stride + i].
// A stride of 0 gives every tick the same row, as in a constant current.
struct TickRows {
  const float* data;
  int64_t tick_stride;
};

// The neurons [begin, end) of a population that lives for `ticks` ticks from membrane 0.
struct LifRange {
  Lif neuron;
  int ticks;
  int64_t begin;
  int64_t end;
};

// Writes the spikes (0 or 1) of the range; spikes[tick * spike_stride + i].
void LifForward(const LifRange& range, TickRows current, float* spikes, int64_t spike_stride);

// dL/dI from dL/ds. With V_t = decay V'_{t-1} + I_t, s_t = 1[V_t >= V_th], V'_t = V_t (1 - s_t),
// the reset's s_t taken as a constant ("detached"):
//   dL/dV_t = dL/ds_t surrogate(V_t - V_th) + (1 - s_t) decay dL/dV_{t+1},   dL/dI_t = dL/dV_t.
// The membrane is computed again from the current rather than kept. Writes current_gradient[tick *
// stride + i] with the stride of `current`; where that is 0, one row with the sum over the ticks.
void LifBackward(const LifRange& range, const Surrogate& surrogate, TickRows current,
                 TickRows spike_gradient, float* current_gradient);

}  // namespace spikeserve

#endif  // TRAIN_MODEL_LIF_KERNELS_H_
