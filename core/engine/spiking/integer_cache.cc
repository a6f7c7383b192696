#include "core/engine/spiking/integer_cache.h"

#include <algorithm>

#include "core/engine/spiking/packed/packed_linear.h"
#include "core/engine/token.h"

namespace spikeserve {

using kernels::kSlotBlock;
using kernels::PairWidth;

IntegerBand::IntegerBand(const ModelConfig& config)
    : timesteps_(static_cast<size_t>(kTokensPerTimestep) * config.context),
      held_(PadToLanes(static_cast<int>(timesteps_.size()), kSlotBlock)) {}

int IntegerBand::Add(int64_t timestep) {
  const int added = slot(tokens_++);
  timesteps_[added] = timestep;
  held_[added] = -1;
  used_slots_ = std::max(used_slots_, PadToLanes(added + 1, kSlotBlock));
  return added;
}

int IntegerBand::Expire(int64_t first) {
  if (tokens_ == 0 || timesteps_[first_] >= first) return -1;
  const int expired = first_;
  held_[expired] = 0;
  first_ = slot(1);
  --tokens_;
  return expired;
}

IntegerCache::IntegerCache(const ModelConfig& config)
    : planes_(config.attention_planes()),
      heads_(config.heads),
      head_size_(config.head_size()),
      ticks_(config.ticks),
      words_((head_size_ + 31) / 32),
      slots_(PadToLanes(kTokensPerTimestep * config.context, kSlotBlock)),
      keys_(static_cast<size_t>(heads_) * slots_ * ticks_ * words_),
      values_(static_cast<size_t>(planes_) * heads_ * slots_ / 2 * PairWidth(head_size_) + kLanes),
      nonzero_(static_cast<size_t>(planes_) * heads_ * slots_),
      sums_(planes_ * sums_width()) {}

kernels::HeadSlots IntegerCache::head(int head, int plane) const {
  const auto slots = static_cast<size_t>(slots_);
  const size_t first = (static_cast<size_t>(plane) * heads_ + head) * slots;
  return {.keys = keys_.data() + head * slots * ticks_ * words_,
          .words = ticks_ * words_,
          .values = values_.data() + first / 2 * PairWidth(head_size_),
          .head_size = head_size_,
          .nonzero = nonzero_.data() + first};
}

uint64_t IntegerCache::Store(int slot, const uint32_t* keys, const int16_t* counts) {
  const int ticks = ticks_;  // copies, which no store of a key can change
  const int key_words = words_ * kSlotBlock;
  const int tick_words = heads_ * words_;
  for (int head = 0; head < heads_; ++head) {
    const size_t block = (static_cast<size_t>(head) * slots_ + slot) / kSlotBlock;
    for (int word = 0; word < words_; ++word, ++keys) {
      uint32_t* key =
          keys_.data() + block * ticks * key_words + word * kSlotBlock + slot % kSlotBlock;
      for (int tick = 0; tick < ticks; ++tick, key += key_words) *key = keys[tick * tick_words];
    }
  }
  const auto width = static_cast<size_t>(PadToLanes(heads_ * head_size_));
  uint64_t nonzero = 0;
  for (int plane = 0; plane < planes_; ++plane) {
    nonzero += kernels::StoreValues(counts + plane * width, values_of(slot, plane));
  }
  return nonzero;
}

void IntegerCache::Remove(int slot) {
  for (int plane = 0; plane < planes_; ++plane) kernels::RemoveValues(values_of(slot, plane));
}

kernels::SlotValues IntegerCache::values_of(int slot, int plane) {
  const size_t first = static_cast<size_t>(plane) * heads_ * slots_;
  return {.heads = heads_,
          .head_size = head_size_,
          .slots = slots_,
          .slot = slot,
          .pairs = values_.data() + first / 2 * PairWidth(head_size_),
          .nonzero = nonzero_.data() + first,
          .sums = sums_.data() + plane * sums_width()};
}

}  // namespace spikeserve
