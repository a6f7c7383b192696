#include "core/engine/spiking/attention_cache.h"

namespace spikeserve {

AttentionBand::AttentionBand(const ModelConfig& config)
    : context_(config.context), valid_((kTokensPerTimestep * config.context + 31) / 32, 0u) {}

void AttentionBand::Advance(int64_t timestep) {
  for (const TokenKind kind : {TokenKind::kReturn, TokenKind::kState, TokenKind::kAction}) {
    const int slot = Slot(timestep, kind);
    const uint32_t bit = 1u << (slot % 32);
    if (valid_[slot / 32] & bit) --tokens_;
    valid_[slot / 32] &= ~bit;
  }
}

int AttentionBand::Slot(int64_t timestep, TokenKind kind) const {
  return kTokensPerTimestep * static_cast<int>(timestep % context_) + static_cast<int>(kind);
}

AttentionCache::AttentionCache(const ModelConfig& config, int slots)
    : ticks_(config.ticks),
      heads_(config.heads),
      head_size_(config.head_size()),
      words_((config.head_size() + 31) / 32),
      slots_(slots),
      keys_(static_cast<size_t>(ticks_) * heads_ * words_ * slots, 0u),
      values_(static_cast<size_t>(ticks_) * heads_ * words_ * slots, 0u),
      occupied_(static_cast<size_t>(ticks_) * heads_ * slots / 32, 0u),
      value_spikes_(slots, 0) {}

void AttentionCache::Store(const uint32_t* keys, const uint32_t* values, uint64_t value_spikes,
                           int slot) {
  const int rows = ticks_ * heads_ * words_;
  for (int i = 0; i < rows; ++i) keys_[static_cast<size_t>(i) * slots_ + slot] = keys[i];
  value_spikes_[slot] = value_spikes;
  kernels::StoreValues(values, slot,
                       {.ticks = ticks_, .heads = heads_, .words = words_, .slots = slots_},
                       values_.data(), occupied_.data());
}

kernels::AttentionWindow AttentionCache::Window(const AttentionBand& band) const {
  return {.ticks = ticks_,
          .heads = heads_,
          .head_size = head_size_,
          .words = words_,
          .slots = slots_,
          .keys = keys_.data(),
          .values = values_.data(),
          .occupied = occupied_.data(),
          .valid = band.valid().data()};
}

uint64_t AttentionCache::ValueSpikes(const AttentionBand& band) const {
  uint64_t spikes = 0;
  for (int slot = 0; slot < slots_; ++slot) {
    spikes += value_spikes_[slot] * (band.valid()[slot / 32] >> (slot % 32) & 1u);
  }
  return spikes;
}

}  // namespace spikeserve
