// The inner loops of the streaming engine, on Highway with run-time dispatch.
//
// Every sum is per lane, or in the one order the reference fixes, so that each target gives the
// same bits. Pure functions on plain arrays; safe to call from many threads. Symbols: T ticks, H
// heads, d_h head size, W = 32-bit words a head's slice of a tick takes, `width` a multiple of
// kLanes.
#ifndef CORE_ENGINE_KERNELS_H_
#define CORE_ENGINE_KERNELS_H_

#include <cstdint>
#include <string>
#include <vector>

#include "core/engine/packed_weights.h"
#include "core/neuron/lif.h"

namespace spikeserve::kernels {

// What flows into a population: at tick t (0 ... ticks-1) the current is the bias plus the vectors
// terms[offsets[t]] ... terms[offsets[t+1]-1], added in that order.
struct Drive {
  int ticks = 0;
  std::vector<const float*> terms;
  std::vector<int> offsets;  // [ticks + 1]
};

// periods[j] (see Lif::Period) of a rate coder's neurons under the currents x[j] * gain[j] +
// bias[j], j < size.
void CoderPeriods(const Lif& lif, const float* x, const float* gain, const float* bias, int size,
                  int ticks, int32_t* periods);

// sum[lane] = the rows of `members`, in that order, added to zero; lane < width.
void SumRows(const PackedLinear& linear, const int32_t* members, int count, int width, float* sum);

// Runs LIF neurons from zero. bits: [T][width / 32], lane i is bit i % 32 of word i / 32.
void LifBits(const Lif& lif, const float* bias, const Drive& drive, int width, uint32_t* bits);

// As LifBits, but counts: counts[lane] is the number of spikes in `drive.ticks` ticks.
void LifCounts(const Lif& lif, const float* bias, const Drive& drive, int width, float* counts);

// output[lane] = bias + the products with nonzero inputs, inputs ascending; lane < linear.width.
// Returns the number of products of a nonzero input and a nonzero weight.
uint64_t Affine(const PackedLinear& linear, const float* input, float* output);

// Affine for `ticks` inputs at once: input [ticks][stride], output [ticks][linear.width], of which
// lanes from linear.outputs on may be left as they were. For few outputs and inputs that are seldom
// zero.
uint64_t AffineTicks(const PackedLinear& linear, const float* input, int stride, int ticks,
                     float* output);

// The softmax of the first `size` entries of every row [stride], in place; `stride` is a multiple
// of kLanes, and the other entries of a row are overwritten.
void Softmax(float* rows, int count, int stride, int size);

// What the heads say about one token: [ticks][heads][head_size].
struct HeadOutputs {
  int ticks = 0;
  int heads = 0;
  int head_size = 0;
  const float* y = nullptr;

  const float* at(int tick, int head) const {
    return y + (static_cast<size_t>(tick) * heads + head) * head_size;
  }
};

// merged = mean over ticks of the heads times their gates [ticks][stride], summed [head_size]
// (eq. 4.11) or side by side [heads * head_size].
void GateHeads(const HeadOutputs& heads, const float* gates, int stride, bool concat,
               float* merged);

// Bits set in words[0, count).
uint64_t CountBits(const uint32_t* words, int count);

// The LayerNorm of core/math, same bits.
void LayerNorm(const float* weight, const float* bias, float* x, int size);

// A window of keys and values as bits; the token in slot s is bit s % 32 of word s / 32 where slots
// are bits.
struct AttentionWindow {
  int ticks = 0;
  int heads = 0;
  int head_size = 0;                 // d_h
  int words = 0;                     // W
  int slots = 0;                     // S, a multiple of 32
  const uint32_t* keys = nullptr;    // [T][H][W][S]: bits are dimensions
  const uint32_t* values = nullptr;  // [T][H][S / 32][32 W]: bits are slots
  const uint32_t* valid = nullptr;   // [S / 32]: the slots the query may attend to, at least one
};

// y [T][H][d_h], contiguous, for a query [T][H][W]: the softmax over valid slots of c_h popcount(q
// & k), times v. `weight` is [H][d_h + 1]: exp(-|c_h| distance); `scale` [H] is c_h, whose sign
// says whether the best overlap is the largest. Returns the sum of popcount(q & k) over ticks,
// heads and valid slots.
uint64_t Attend(const AttentionWindow& window, const uint32_t* query, const float* weight,
                const float* scale, float* y);

// Writes one token's value bits [T][H][W] into slot `slot` of `values` (layout as in
// AttentionWindow).
void StoreValues(const uint32_t* bits, int slot, const AttentionWindow& window, uint32_t* values);

// Names of the SIMD targets this processor can run, best first, and a switch that lets tests force
// one of them (empty: the best again).
std::vector<std::string> SupportedTargets();
void ForceTargetForTest(const std::string& name);

}  // namespace spikeserve::kernels

#endif  // CORE_ENGINE_KERNELS_H_
