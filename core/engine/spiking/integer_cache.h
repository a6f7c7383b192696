// Stores the keys and values of one layer over the last N timesteps for attention in integer
// arithmetic: a key as bits by tick and head, a value as spike counts, and the sum of all values.
//
// Not thread-safe.
#ifndef CORE_ENGINE_SPIKING_INTEGER_CACHE_H_
#define CORE_ENGINE_SPIKING_INTEGER_CACHE_H_

#include <cstdint>
#include <vector>

#include "core/engine/spiking/aligned_vector.h"
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

class IntegerCache {
 public:
  IntegerCache(const ModelConfig& config, int slots);

  // Stores a token. `keys` is [T][H][W], where the W = ceil(d_h / 32) words are a head's bits at a
  // tick; `counts` is [d].
  void Store(int slot, const uint32_t* keys, const int16_t* counts);
  // Subtracts the values of a token that leaves the band from their sum.
  void Remove(int slot);

  const uint32_t* keys(int slot) const { return keys_.data() + slot * key_words_; }
  const int16_t* counts(int slot) const { return counts_.data() + slot * size_; }
  // Returns the number of values of a head that are not 0.
  int nonzero(int slot, int head) const { return nonzero_[slot * heads_ + head]; }
  // Returns the sums of the values of all tokens, [d].
  const int32_t* sums() const { return sums_.data(); }

 private:
  size_t heads_;
  size_t size_;                    // d
  size_t key_words_;               // T H W
  AlignedVector<uint32_t> keys_;   // [slots][T][H][W]
  AlignedVector<int16_t> counts_;  // [slots][d]
  std::vector<uint16_t> nonzero_;  // [slots][H]
  AlignedVector<int32_t> sums_;    // [d]
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_SPIKING_INTEGER_CACHE_H_
