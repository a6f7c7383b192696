// Computes attention in integer arithmetic for one token (docs/design/integer.md).
//
// Not thread-safe.
#pragma once

#include <cstdint>
#include <vector>

#include "absl/container/inlined_vector.h"
#include "core/engine/counts.h"
#include "core/engine/spiking/integer_cache.h"
#include "core/engine/spiking/kernels/integer_attention_kernels.h"
#include "core/engine/spiking/packed/aligned_vector.h"
#include "core/model/config.h"

namespace spikeserve {

// What attention reads in one layer.
struct IntegerKeys {
  const ModelConfig& config;
  const std::vector<int16_t>& scales;  // [H]
  const IntegerBand& band;
  const IntegerCache& cache;
  const uint32_t* query;  // [T][H][W], or null if no neuron fires
};

// Ticks that attention takes together: some of the planes of IntegerCache.
using TickGroup = absl::InlinedVector<int, 16>;

// Sets `groups` to those of a query: each plane at which it fires, and all others together.
void GroupTicks(const IntegerKeys& keys, std::vector<TickGroup>* groups);

// Buffers of one thread. Their contents do not outlive a call.
class IntegerAttention {
 public:
  // Sets y [d] to the outputs of all heads for a group of ticks. A head whose query does not fire
  // returns the mean of the values. Adds the operations to `counts`.
  void Attend(const IntegerKeys& keys, const TickGroup& group, int16_t* y, Counts* counts);

 private:
  // Sets query_ to the words of a head's query that are not 0.
  void ReadQuery(const IntegerKeys& keys, const TickGroup& group, int head);
  // Sets weights_ to those of the slots for query_, and returns their sum.
  int32_t WeighKeys(const IntegerKeys& keys, const TickGroup& group, int head, Counts* counts);
  // Returns the sums of the weighted values of a head, [pad(d_h)].
  const int32_t* SumValues(const IntegerKeys& keys, const TickGroup& group, int head,
                           Counts* counts);
  // Returns the sums of all values of `size` lanes, from the lane `first` of [d] on, [pad(size)].
  const int32_t* SumAllValues(const IntegerKeys& keys, const TickGroup& group, int first, int size,
                              Counts* counts);
  // Adds up sums_of(plane) [size] over a group.
  template <class SumsOf>
  const int32_t* SumPlanes(const TickGroup& group, int size, SumsOf sums_of);

  std::vector<kernels::QueryWord> query_;
  AlignedVector<int32_t> overlaps_;  // [slots]
  AlignedVector<int16_t> weights_;   // [slots]
  AlignedVector<int32_t> plane_;     // sums of one plane, [pad(d_h)]
  AlignedVector<int32_t> sums_;      // of all planes of a group, [pad(d_h)] or [pad(d)]
};

}  // namespace spikeserve
