// Groups the spikes of a population by head.
//
// All functions are thread-safe on distinct arrays.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>

#include "core/engine/spiking/packed/packed_linear.h"
#include "core/model/config.h"

namespace spikeserve {

// Returns `count` (1 to 32) bits of `row`, starting at bit `first`.
inline uint32_t TakeBits(const uint32_t* row, int first, int count) {
  const int shift = first % 32;
  uint64_t bits = row[first / 32] >> shift;
  if (shift + count > 32) bits |= static_cast<uint64_t>(row[first / 32 + 1]) << (32 - shift);
  return static_cast<uint32_t>(bits & ((uint64_t{1} << count) - 1));
}

// Copies the spikes `bits` [T][pad(d) / 32] to `heads` [T][H][W], where the W = ceil(d_h / 32)
// words are a head's bits at a tick.
inline void GroupByHead(const ModelConfig& config, const uint32_t* bits, uint32_t* heads) {
  const int size = config.head_size();
  const size_t words = PadToLanes(config.hidden_size) / kLanes;
  for (int tick = 0; tick < config.ticks; ++tick) {
    const uint32_t* row = bits + tick * words;
    for (int head = 0; head < config.heads; ++head) {
      for (int k = 0; k < size; k += 32) {
        *heads++ = TakeBits(row, head * size + k, std::min(32, size - k));
      }
    }
  }
}

}  // namespace spikeserve
