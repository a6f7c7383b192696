// The inner loops of training: LIF neurons over T ticks and their backward pass, on plain arrays.
//
// Compiled once per vector extension of x86-64, where the variant is selected when the program
// starts, so that one binary runs on every processor; on arm64 once. All variants compute the same
// bits. Safe to call from many threads on disjoint ranges of neurons.
#pragma once

#include <cstdint>

#include "core/neuron/lif.h"
#include "core/neuron/shift_lif.h"
#include "train/neuron/surrogate.h"

namespace spikeserve {

// One row per tick, with one value per neuron: element (tick, i) is data[tick * tick_stride + i].
// With a stride of 0 all ticks share one row, as for a constant current.
struct TickRows {
  const float* data;
  int64_t tick_stride;
};

// The neurons [begin, end) of a population, simulated for `ticks` ticks from membrane 0.
struct LifRange {
  Lif neuron;
  int ticks;
  int64_t begin;
  int64_t end;
};

// Writes the spikes (0 or 1) of the range to spikes[tick * spike_stride + i].
void LifForward(const LifRange& range, TickRows current, float* spikes, int64_t spike_stride);

// Computes dL/dI from dL/ds. With V_t = decay V'_{t-1} + I_t, s_t = 1[V_t >= V_th], V'_t = V_t (1 -
// s_t), and s_t treated as a constant in the reset ("detached"):
//   dL/dV_t = dL/ds_t surrogate(V_t - V_th) + (1 - s_t) decay dL/dV_{t+1},   dL/dI_t = dL/dV_t.
// Recomputes the membrane from the current, so that the forward pass does not have to store it.
// Writes current_gradient[tick * stride + i], where stride is current.tick_stride; if that is 0,
// writes one row with the sum over the ticks.
void LifBackward(const LifRange& range, const Surrogate& surrogate, TickRows current,
                 TickRows spike_gradient, float* current_gradient);

// Integer neurons in a tensor whose last dimension is a population of `width` neurons: the one at
// index i has the threshold and the scale of element i % width. Thresholds, biases and currents are
// integers of 16 bits, stored as float32.
struct IntegerLifRange {
  ShiftLif neuron;
  int ticks;
  int64_t begin;
  int64_t end;
  const float* threshold;  // [width], in units of scale
  const float* scale;      // [width]
  int64_t width;
  // The current includes the bias. At a tick whose event is 0, which has one for
  // each `width` neurons, the current is the bias and the neurons cannot fire.
  const float* bias;  // [width]
  TickRows events;
};

// As LifForward, exactly as the neuron computes it. REQUIRES, here and below: a current per
// tick, so a tick_stride above 0.
void IntegerLifForward(const IntegerLifRange& range, TickRows current, float* spikes,
                       int64_t spike_stride);

// As LifBackward, for currents in units of the scale: treats the rounding of the membrane as the
// identity and its saturation as absent, and evaluates the surrogate at scale (V - V_th).
void IntegerLifBackward(const IntegerLifRange& range, const Surrogate& surrogate, TickRows current,
                        TickRows spike_gradient, float* current_gradient);

}  // namespace spikeserve
