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
  // Sets y [d] to the outputs of all heads for a query [T][H][W]. A head whose query does not fire
  // returns the mean of the values. `scales` are [H]. Adds the operations to `counts`.
  void Attend(const ModelConfig& config, const std::vector<int16_t>& scales,
              const IntegerBand& band, const IntegerCache& cache, const uint32_t* query, int16_t* y,
              Counts* counts);

 private:
  // Sets query_ to the query of `head`, and overlaps_ to its overlaps with every key. Returns false
  // if the query does not fire.
  bool FindOverlaps(const ModelConfig& config, const IntegerCache& cache, const uint32_t* query,
                    int head, Counts* counts);
  // Sets sums_ to the values of `head`, weighted by overlaps_.
  void WeighValues(const ModelConfig& config, const IntegerCache& cache, int head, Counts* counts);

  std::vector<int> slots_;           // of the tokens
  std::vector<uint64_t> query_;      // see JoinTicks
  AlignedVector<int32_t> overlaps_;  // [pad(tokens)]; then the weights of the keys
  std::vector<kernels::WeightedValues> values_;
  AlignedVector<int32_t> sums_;  // [pad(d_h)]
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_SPIKING_INTEGER_ATTENTION_H_
