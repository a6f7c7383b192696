// Stores the keys and values of one layer over the last N timesteps as bits.
//
// The tokens occupy the slots of a ring, in their order. There is one plane of key bits and one of
// value bits for each tick and head; kernels::AttentionWindow describes them. A plane without a set
// bit takes no memory. Not thread-safe.
#pragma once

#include <cstdint>
#include <vector>

#include "core/engine/spiking/kernels/attention_kernels.h"
#include "core/engine/spiking/packed/aligned_vector.h"
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
  // Adds the token in `slot`. REQUIRES: it follows the token that was added last.
  void Add(int slot) {
    valid_[slot / 32] |= 1u << (slot % 32);
    last_ = slot;
    ++tokens_;
  }
  // Returns the number of tokens inside the band.
  int tokens() const { return tokens_; }
  // Returns the slot of a token.
  int Slot(int64_t timestep, TokenKind kind) const;
  // Returns the slots of the oldest and of the newest token inside the band. REQUIRES: tokens().
  int first() const { return (last_ + slots() - tokens_ + 1) % slots(); }
  int last() const { return last_; }
  // Returns the number of slots of the ring: at least 3 N, and a multiple of 64.
  int slots() const { return static_cast<int>(valid_.size()) * 32; }
  // Returns the slots inside the band as bits, [slots / 32].
  const std::vector<uint32_t>& valid() const { return valid_; }

 private:
  int context_ = 0;
  int tokens_ = 0;
  int last_ = 0;
  std::vector<uint32_t> valid_;
};

// The cached keys and values of one layer.
class AttentionCache {
 public:
  // `slots` is AttentionBand::slots().
  AttentionCache(const ModelConfig& config, int slots);

  // Stores a token's keys and values in `slot`. Both are [T][H][W], where the W = ceil(d_h / 32)
  // words are a head's bits at a tick. `value_spikes` is the number of bits set in `values`.
  // REQUIRES: the slot follows the one that was stored last.
  void Store(const uint32_t* keys, const uint32_t* values, uint64_t value_spikes, int slot);

  // Returns what a query may attend to through `band`. The result points into this object and
  // `band`, and is valid until the next Store.
  kernels::AttentionWindow Window(const AttentionBand& band) const;

  // Returns the number of value spikes of all tokens in `band`, over all ticks and heads.
  uint64_t ValueSpikes(const AttentionBand& band) const;

 private:
  // The planes of the keys, or those of the values. A set of planes is ceil(T H / 64) words, in
  // which bit i is the plane number i of [T][H].
  struct Planes {
    std::vector<int32_t> number;    // [T][H]: number of the plane in bits_, or kNoPlane
    std::vector<uint64_t> exist;    // the set of planes that have a number
    std::vector<uint64_t> of_slot;  // [S]: the set of planes in which the slot has a bit
  };
  // Number of value spikes of all tokens before and after one was stored, modulo 2^32.
  struct Spikes {
    uint32_t before = 0;
    uint32_t after = 0;
  };

  // Prepares that the token in `slot` is replaced by one with `bits` [T][H][W]: sets changed_ to
  // the planes in which one of them has a bit, and creates those that do not exist.
  void Change(Planes& planes, const uint32_t* bits, int slot);
  // Takes the planes away in which no slot has a bit.
  void FreePlanes(Planes& planes);
  int NewPlane();
  // Write a token's keys to the planes of changed_.
  void StoreWords(const uint32_t* keys, int slot);
  void StoreRows(const uint32_t* keys, int slot);
  // Clears the 32 slots from `slot` on in planes that are rows. All of their tokens have expired.
  void ClearRows(int slot);
  kernels::AttentionWindow Shape() const;
  uint32_t* Plane(int number) { return bits_.data() + number * plane_words_; }

  int ticks_;
  int heads_;
  int head_size_;
  int words_;
  int sets_;  // number of words of a set of planes
  int slots_;
  size_t plane_words_;
  Planes keys_;
  Planes values_;
  AlignedVector<uint32_t> bits_;    // [planes][32 W S / 32]
  std::vector<int32_t> free_;       // numbers of planes without a set bit
  std::vector<uint32_t> occupied_;  // [T][H][S / 32]: the slots with at least one value bit
  std::vector<uint64_t> changed_;   // the set of planes that the running Store changes
  std::vector<Spikes> spikes_;      // [S]: of the values
  uint32_t total_spikes_ = 0;       // of the values of all tokens, modulo 2^32
};

}  // namespace spikeserve
