// Stores the keys and values of one layer over the last N timesteps for attention in integer
// arithmetic: a key as bits by head, a value as spike counts, and the sum of all values.
//
// Not thread-safe.
#ifndef CORE_ENGINE_SPIKING_INTEGER_CACHE_H_
#define CORE_ENGINE_SPIKING_INTEGER_CACHE_H_

#include <cstdint>
#include <vector>

#include "core/engine/spiking/packed/aligned_vector.h"
#include "core/model/config.h"

namespace spikeserve {

// The ring of the tokens that attention may see, which all layers share. A token keeps its slot
// until it leaves the band.
class IntegerBand {
 public:
  explicit IntegerBand(const ModelConfig& config);

  // Adds a token of `timestep` and returns its slot.
  int Add(int64_t timestep);
  // Returns the slot of the oldest token if it belongs to a timestep before `first`, and forgets
  // the token. Returns -1 otherwise.
  int Expire(int64_t first);

  int tokens() const { return tokens_; }
  // Returns the slot of a token, counted from the oldest one.
  int slot(int i) const {
    const int slot = first_ + i;
    return slot < slots() ? slot : slot - slots();
  }
  int slots() const { return static_cast<int>(timesteps_.size()); }

 private:
  int first_ = 0;
  int tokens_ = 0;
  std::vector<int64_t> timesteps_;  // [3 N]
};

// Copies the bits of a head from `bits` [T][H][W], where the W = ceil(d_h / 32) words are a head's
// bits at a tick, to `joined` [ceil(T W / 2)], tick after tick. Returns whether one of them is set.
bool JoinTicks(const ModelConfig& config, const uint32_t* bits, int head, uint64_t* joined);

class IntegerCache {
 public:
  IntegerCache(const ModelConfig& config, int slots);

  // Stores a token. `keys` is [T][H][W], as for JoinTicks; `counts` is [d].
  void Store(const ModelConfig& config, int slot, const uint32_t* keys, const int16_t* counts);
  // Subtracts the values of a token that leaves the band from their sum.
  void Remove(int slot);

  // Returns the number of words of a head's key, as JoinTicks writes it.
  int key_words() const { return static_cast<int>(key_words_); }
  // Returns the keys of a head. That of slot s begins at word s * key_stride().
  const uint64_t* keys(int head) const { return keys_.data() + head * key_words_; }
  size_t key_stride() const { return heads_ * key_words_; }
  // Returns the values of a token, [d] and kLanes more numbers, which mean nothing.
  const int16_t* counts(int slot) const { return counts_.data() + slot * size_; }
  // Returns the number of values of a head that are not 0.
  int nonzero(int slot, int head) const { return nonzero_[slot * heads_ + head]; }
  // Returns the sums of the values of all tokens, [d] and kLanes zeros.
  const int32_t* sums() const { return sums_.data(); }

 private:
  size_t heads_;
  size_t size_;                    // d
  size_t key_words_;               // J = ceil(T W / 2)
  AlignedVector<uint64_t> keys_;   // [slots][H][J]
  AlignedVector<int16_t> counts_;  // [slots][d], and kLanes zeros
  std::vector<uint16_t> nonzero_;  // [slots][H]
  AlignedVector<int32_t> sums_;    // [d], and kLanes zeros
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_SPIKING_INTEGER_CACHE_H_
