// Stores the keys and values of one layer over the last N timesteps for attention in integer
// arithmetic: a key as the bits of its ticks, a value as spike counts by plane
// (ModelConfig::attention_planes()), and for each plane the sum of all values.
//
// Not thread-safe.
#pragma once

#include <cstdint>
#include <vector>

#include "core/engine/spiking/kernels/integer_attention_kernels.h"
#include "core/engine/spiking/packed/aligned_vector.h"
#include "core/engine/spiking/packed/packed_linear.h"
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
  // Returns the number of slots of the ring, 3 N.
  int slots() const { return static_cast<int>(timesteps_.size()); }
  // Returns the number of slots that have ever held a token, in whole blocks.
  int used_slots() const { return used_slots_; }
  // Returns for each slot all bits if it holds a token, and 0 otherwise, [used_slots()].
  const int32_t* held() const { return held_.data(); }

 private:
  // Returns the slot of a token, counted from the oldest one.
  int slot(int i) const { return (first_ + i) % slots(); }

  int first_ = 0;
  int tokens_ = 0;
  int used_slots_ = 0;
  std::vector<int64_t> timesteps_;  // [3 N]
  AlignedVector<int32_t> held_;     // [3 N], in whole blocks
};

class IntegerCache {
 public:
  explicit IntegerCache(const ModelConfig& config);

  // Stores a token. `keys` is [T][H][W], where the W = ceil(d_h / 32) words are a head's bits at a
  // tick; `counts` is [planes][pad(d)]. Returns the number of counts that are not 0.
  uint64_t Store(int slot, const uint32_t* keys, const int16_t* counts);
  // Subtracts the values of a token that leaves the band from their sum.
  void Remove(int slot);

  // Returns the keys of a head, and its values in a plane.
  kernels::HeadSlots head(int head, int plane) const;
  int head_size() const { return head_size_; }  // d_h
  int words() const { return words_; }          // W

  // Returns the sums of the values of all tokens in a plane, [d] and kLanes zeros.
  const int32_t* sums(int plane) const { return sums_.data() + plane * sums_width(); }

 private:
  kernels::SlotValues values_of(int slot, int plane);
  size_t sums_width() const { return static_cast<size_t>(heads_) * head_size_ + kLanes; }

  int planes_;
  int heads_;
  int head_size_;
  int ticks_;
  int words_;                       // W
  int slots_;                       // 3 N, in whole blocks
  AlignedVector<uint32_t> keys_;    // [H], see HeadSlots
  AlignedVector<uint16_t> values_;  // [planes][H], see HeadSlots
  AlignedVector<int16_t> nonzero_;  // [planes][H], see HeadSlots
  AlignedVector<int32_t> sums_;     // [planes][d and kLanes zeros]
};

}  // namespace spikeserve
