#include "core/engine/spiking/integer_cache.h"

#include <algorithm>

#include "core/engine/token.h"

namespace spikeserve {

IntegerBand::IntegerBand(const ModelConfig& config)
    : timesteps_(static_cast<size_t>(kTokensPerTimestep) * config.context) {}

int IntegerBand::Add(int64_t timestep) {
  const int added = slot(tokens_++);
  timesteps_[added] = timestep;
  return added;
}

int IntegerBand::Expire(int64_t first) {
  if (tokens_ == 0 || timesteps_[first_] >= first) return -1;
  const int expired = first_;
  first_ = slot(1);
  --tokens_;
  return expired;
}

IntegerCache::IntegerCache(const ModelConfig& config, int slots)
    : heads_(config.heads),
      size_(config.hidden_size),
      key_words_(static_cast<size_t>(config.ticks) * config.heads *
                 ((config.head_size() + 31) / 32)),
      keys_(slots * key_words_),
      counts_(slots * size_),
      nonzero_(slots * heads_),
      sums_(size_, 0) {}

void IntegerCache::Store(int slot, const uint32_t* keys, const int16_t* counts) {
  std::copy_n(keys, key_words_, keys_.data() + slot * key_words_);
  std::copy_n(counts, size_, counts_.data() + slot * size_);
  for (size_t k = 0; k < size_; ++k) sums_[k] += counts[k];
  const size_t head_size = size_ / heads_;
  for (size_t head = 0; head < heads_; ++head) {
    const int16_t* const first = counts + head * head_size;
    nonzero_[slot * heads_ + head] =
        static_cast<uint16_t>(head_size - std::count(first, first + head_size, 0));
  }
}

void IntegerCache::Remove(int slot) {
  const int16_t* const values = counts(slot);
  for (size_t k = 0; k < size_; ++k) sums_[k] -= values[k];
}

}  // namespace spikeserve
