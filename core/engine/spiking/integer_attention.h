// Computes attention in integer arithmetic for one token (docs/design/integer.md).
//
// Not thread-safe.
#ifndef CORE_ENGINE_SPIKING_INTEGER_ATTENTION_H_
#define CORE_ENGINE_SPIKING_INTEGER_ATTENTION_H_

#include <cstdint>
#include <vector>

#include "core/engine/counts.h"
#include "core/engine/spiking/integer_cache.h"
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
  // Sets overlaps_ to the overlaps of the query of `head` with every key. Returns false if the
  // query does not fire.
  bool FindOverlaps(const ModelConfig& config, const IntegerBand& band, const IntegerCache& cache,
                    const uint32_t* query, int head, Counts* counts);
  // Replaces overlaps_ by the weights of the keys. Returns their sum.
  int64_t WeighKeys(Attention attention, int64_t scale);

  std::vector<int> active_;        // words of the query's head that are not 0
  std::vector<int64_t> overlaps_;  // [tokens]
  std::vector<int32_t> sums_;      // [d_h]
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_SPIKING_INTEGER_ATTENTION_H_
