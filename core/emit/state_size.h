// The size of spike_state of the emitted C (c/spike_policy.h), which is equal on every processor.
//
// Pure functions, thread-safe.
#ifndef CORE_EMIT_STATE_SIZE_H_
#define CORE_EMIT_STATE_SIZE_H_

#include <cstdint>

#include "core/model/policy.h"

namespace spikeserve {

struct StateSize {
  int word_bits = 32;       // of spike_word: the widest that a head fills, of 8, 16 and 32
  int words = 1;            // of a head at a tick
  int widest = 0;           // the most inputs or outputs of a map or a population
  int text_bytes = 0;       // of a session's labels and ids
  int end_bytes = 0;        // of the end of an episode
  int64_t state_bytes = 0;  // of all
};

StateSize StateSizeOf(const Policy& policy);

}  // namespace spikeserve

#endif  // CORE_EMIT_STATE_SIZE_H_
