// Stores the keys and values of one layer over the last N timesteps as bits.
//
// A token of timestep t occupies slot 3 (t mod N) + its kind, and overwrites the token of timestep
// t - N. The bits of a key word are dimensions, to compute overlaps. The bits of a value word are
// slots, so that one population count gives the number of slots in a set whose value has a given
// bit. Not thread-safe.
#ifndef CORE_ENGINE_SPIKING_ATTENTION_CACHE_H_
#define CORE_ENGINE_SPIKING_ATTENTION_CACHE_H_

#include <cstdint>
#include <vector>

#include "core/engine/spiking/aligned_vector.h"
#include "core/engine/spiking/kernels/attention_kernels.h"
#include "core/engine/token.h"
#include "core/model/config.h"

namespace spikeserve {

// The set of slots whose tokens are inside the band. All layers share it.
class AttentionBand {
 public:
  AttentionBand() = default;
  explicit AttentionBand(const ModelConfig& config);

  // Moves the band to `timestep`: removes the tokens of `timestep` - N.
  void Advance(int64_t timestep);
  // Adds the token in `slot`, which the band does not contain.
  void Add(int slot) {
    valid_[slot / 32] |= 1u << (slot % 32);
    ++tokens_;
  }
  // Returns the number of tokens inside the band.
  int tokens() const { return tokens_; }
  // Returns the slot of a token.
  int Slot(int64_t timestep, TokenKind kind) const;
  // Returns the number of slots, a multiple of 32.
  int slots() const { return static_cast<int>(valid_.size()) * 32; }
  // Returns the slots inside the band as bits, [slots / 32].
  const std::vector<uint32_t>& valid() const { return valid_; }

 private:
  int context_ = 0;
  int tokens_ = 0;
  std::vector<uint32_t> valid_;
};

// The cached keys and values of one layer.
class AttentionCache {
 public:
  AttentionCache(const ModelConfig& config, int slots);

  // Stores a token's keys and values in `slot`. Both are [T][H][W], where the W = ceil(d_h / 32)
  // words are a head's bits at a tick. `value_spikes` is the number of bits set in `values`.
  void Store(const uint32_t* keys, const uint32_t* values, uint64_t value_spikes, int slot);

  // Returns what a query may attend to through `band`. The result points into this object and
  // `band`.
  kernels::AttentionWindow Window(const AttentionBand& band) const;

  // Returns the number of value spikes of all tokens in `band`, over all ticks and heads.
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
