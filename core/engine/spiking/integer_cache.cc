#include "core/engine/spiking/integer_cache.h"

#include <algorithm>

#include "core/engine/spiking/packed/packed_linear.h"
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
      key_words_((static_cast<size_t>(config.ticks) * ((config.head_size() + 31) / 32) + 1) / 2),
      keys_(slots * heads_ * key_words_),
      counts_(slots * size_ + kLanes),
      nonzero_(slots * heads_),
      sums_(size_ + kLanes, 0) {}

bool JoinTicks(const ModelConfig& config, const uint32_t* bits, int head, uint64_t* joined) {
  const int words = (config.head_size() + 31) / 32;
  uint64_t any = 0;
  int n = 0;
  for (int tick = 0; tick < config.ticks; ++tick) {
    const uint32_t* const from = bits + (static_cast<size_t>(tick) * config.heads + head) * words;
    for (int word = 0; word < words; ++word, ++n) {
      const uint64_t low = n % 2 == 0 ? 0 : joined[n / 2];
      joined[n / 2] = low | uint64_t{from[word]} << (n % 2 * 32);
      any |= from[word];
    }
  }
  return any != 0;
}

void IntegerCache::Store(const ModelConfig& config, int slot, const uint32_t* keys,
                         const int16_t* counts) {
  for (size_t head = 0; head < heads_; ++head) {
    JoinTicks(config, keys, static_cast<int>(head),
              keys_.data() + (slot * heads_ + head) * key_words_);
  }
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
