// The keys and values of one layer over the last N timesteps, as bits.
//
// A token of timestep t sits in slot 3 (t mod N) + its kind, where it overwrites the token of
// timestep t - N. Keys are stored with dimensions as bits, for overlaps; values with slots as bits,
// so that "how many of these keys have this value bit" is one population count. Not thread-safe.
#ifndef CORE_ENGINE_SPIKING_ATTENTION_CACHE_H_
#define CORE_ENGINE_SPIKING_ATTENTION_CACHE_H_

#include <cstdint>
#include <vector>

#include "core/engine/spiking/aligned_vector.h"
#include "core/engine/spiking/kernels/attention_kernels.h"
#include "core/engine/token.h"
#include "core/model/config.h"

namespace spikeserve {

// Which slots of the ring hold a token inside the band; the same for every layer.
class AttentionBand {
 public:
  AttentionBand() = default;
  explicit AttentionBand(const ModelConfig& config);

  // Moves the band on to `timestep`: the tokens of timestep - N leave it.
  void Advance(int64_t timestep);
  void Add(int slot) { valid_[slot / 32] |= 1u << (slot % 32); }
  int Slot(int64_t timestep, TokenKind kind) const;
  int slots() const { return static_cast<int>(valid_.size()) * 32; }
  const std::vector<uint32_t>& valid() const { return valid_; }  // [slots / 32], bits

 private:
  int context_ = 0;
  std::vector<uint32_t> valid_;
};

class AttentionCache {
 public:
  AttentionCache(const ModelConfig& config, int slots);

  // Stores a token's keys and values, both [T][H][W] (a head's bits of a tick, W = ceil(d_h / 32)
  // words).
  // `value_spikes` is the number of bits set in `values`.
  void Store(const uint32_t* keys, const uint32_t* values, uint64_t value_spikes, int slot);

  // What a query sees through `band`.
  kernels::AttentionWindow Window(const AttentionBand& band) const;

  // Spikes of all values in `band`, over ticks and heads.
  uint64_t ValueSpikes(const AttentionBand& band) const;

 private:
  int ticks_;
  int heads_;
  int head_size_;
  int words_;
  int slots_;
  AlignedVector<uint32_t> keys_;        // [T][H][W][S]
  AlignedVector<uint32_t> values_;      // [T][H][S / 32][32 W]
  std::vector<uint32_t> occupied_;      // [T][H][S / 32]
  std::vector<uint64_t> value_spikes_;  // [S]
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_SPIKING_ATTENTION_CACHE_H_
