// Computes attention in integer arithmetic for one token (docs/design/integer.md).
//
// Not thread-safe.
#ifndef CORE_ENGINE_SPIKING_INTEGER_ATTENTION_H_
#define CORE_ENGINE_SPIKING_INTEGER_ATTENTION_H_

#include <cstdint>
#include <vector>

#include "core/engine/counts.h"
#include "core/engine/spiking/integer_cache.h"
#include "core/engine/spiking/kernels/integer_attention_kernels.h"
#include "core/engine/spiking/packed/aligned_vector.h"
#include "core/model/config.h"

namespace spikeserve {

// Buffers of one thread. Their contents do not outlive a call.
class IntegerAttention {
 public:
  // Sets y [d] to the outputs of all heads for a query [T][H][W], or null if no neuron fires. A
  // head whose query does not fire returns the mean of the values, unless there are biases.
  // `scales` are [H]; `biases` are RingBiases() of 3 N slots, or null. Adds the operations to
  // `counts`.
  void Attend(const ModelConfig& config, const std::vector<int16_t>& scales, const int16_t* biases,
              const IntegerBand& band, const IntegerCache& cache, const uint32_t* query, int16_t* y,
              Counts* counts);

 private:
  // Sets query_ to the words of a head's query that are not 0.
  void ReadQuery(const ModelConfig& config, const uint32_t* query, int head);
  // Sets weights_ to those of the slots for query_, and returns their sum.
  // `biases` are those of the head, or null.
  int32_t WeighKeys(const ModelConfig& config, int32_t scale, const int16_t* biases,
                    const IntegerBand& band, const kernels::HeadSlots& head, Counts* counts);

  std::vector<kernels::QueryWord> query_;
  AlignedVector<int32_t> overlaps_;  // [slots]
  AlignedVector<int16_t> weights_;   // [slots]
  AlignedVector<int32_t> sums_;      // [pad(d_h)]
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_SPIKING_INTEGER_ATTENTION_H_
