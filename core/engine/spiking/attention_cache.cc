#include "core/engine/spiking/attention_cache.h"

#include <algorithm>
#include <bit>

namespace spikeserve {
namespace {

constexpr int kWordSlots = 32;
constexpr int32_t kNoPlane = kernels::AttentionWindow::kNoPlane;

// Returns the number of slots for the tokens of N timesteps. A long ring has keys in rows
// (AttentionWindow::HasKeyRows), and spare slots, so that expired tokens are cleared many at a
// time.
int RingSlots(int context) {
  constexpr int kLongRing = 1024;
  constexpr int kUnit = 64;
  constexpr int kRows = kernels::AttentionWindow::kRowSlots;
  const int tokens = kTokensPerTimestep * context;
  if (tokens >= kLongRing) return (tokens + kWordSlots + kRows - 1) / kRows * kRows;
  const int slots = (tokens + kUnit - 1) / kUnit * kUnit;
  return slots % kRows == 0 ? slots + kUnit : slots;
}

// Calls visit(i) for every bit i that is set in `set`, ascending.
template <class Visit>
void ForEach(const std::vector<uint64_t>& set, Visit visit) {
  for (size_t i = 0; i < set.size(); ++i) {
    for (uint64_t bits = set[i]; bits != 0; bits &= bits - 1) {
      visit(static_cast<int>(64 * i) + std::countr_zero(bits));
    }
  }
}

}  // namespace

AttentionBand::AttentionBand(const ModelConfig& config)
    : context_(config.context), valid_(RingSlots(config.context) / kWordSlots, 0u) {}

void AttentionBand::Advance(int64_t timestep) {
  if (timestep < context_) return;
  for (const TokenKind kind : {TokenKind::kReturn, TokenKind::kState, TokenKind::kAction}) {
    const int slot = Slot(timestep - context_, kind);
    const uint32_t bit = 1u << (slot % kWordSlots);
    if (valid_[slot / kWordSlots] & bit) --tokens_;
    valid_[slot / kWordSlots] &= ~bit;
  }
}

int AttentionBand::Slot(int64_t timestep, TokenKind kind) const {
  return static_cast<int>((kTokensPerTimestep * timestep + static_cast<int>(kind)) % slots());
}

AttentionCache::AttentionCache(const ModelConfig& config, int slots)
    : ticks_(config.ticks),
      heads_(config.heads),
      head_size_(config.head_size()),
      words_((config.head_size() + 31) / 32),
      sets_((config.ticks * config.heads + 63) / 64),
      slots_(slots),
      plane_words_(static_cast<size_t>(words_) * slots),
      occupied_(static_cast<size_t>(ticks_) * heads_ * slots / kWordSlots, 0u),
      changed_(sets_),
      spikes_(slots) {
  free_.reserve(2 * static_cast<size_t>(ticks_) * heads_);  // all planes
  for (Planes* planes : {&keys_, &values_}) {
    planes->number.assign(static_cast<size_t>(ticks_) * heads_, kNoPlane);
    planes->exist.assign(sets_, 0u);
    planes->of_slot.assign(static_cast<size_t>(sets_) * slots, 0u);
  }
}

void AttentionCache::Store(const uint32_t* keys, const uint32_t* values, uint64_t value_spikes,
                           int slot) {
  if (slot == 0) {  // once in every turn of the ring
    FreePlanes(keys_);
    FreePlanes(values_);
  }
  if (Shape().HasKeyRows()) {
    if (slot % kWordSlots == 0) ClearRows(slot);
    Change(keys_, keys, slot);
    StoreRows(keys, slot);
  } else {
    Change(keys_, keys, slot);
    StoreWords(keys, slot);
  }
  Change(values_, values, slot);
  kernels::StoreValues(values, slot, Shape(), changed_.data(), values_.number.data(), bits_.data(),
                       occupied_.data());
  spikes_[slot].before = total_spikes_;
  total_spikes_ += static_cast<uint32_t>(value_spikes);
  spikes_[slot].after = total_spikes_;
}

void AttentionCache::Change(Planes& planes, const uint32_t* bits, int slot) {
  uint64_t* const of_slot = planes.of_slot.data() + static_cast<size_t>(slot) * sets_;
  changed_.assign(of_slot, of_slot + sets_);
  kernels::FindNonzero(bits, ticks_ * heads_, words_, of_slot);
  for (int set = 0; set < sets_; ++set) {
    changed_[set] |= of_slot[set];
    for (uint64_t added = of_slot[set] & ~planes.exist[set]; added != 0; added &= added - 1) {
      planes.number[64 * set + std::countr_zero(added)] = NewPlane();
    }
    planes.exist[set] |= of_slot[set];
  }
}

void AttentionCache::FreePlanes(Planes& planes) {
  changed_ = planes.exist;
  for (size_t i = 0; i < planes.of_slot.size(); ++i) changed_[i % sets_] &= ~planes.of_slot[i];
  ForEach(changed_, [&](int i) {
    free_.push_back(planes.number[i]);
    planes.number[i] = kNoPlane;
    planes.exist[i / 64] &= ~(uint64_t{1} << (i % 64));
  });
}

void AttentionCache::StoreWords(const uint32_t* keys, int slot) {
  ForEach(changed_, [&](int i) {
    uint32_t* const plane = Plane(keys_.number[i]) + slot;
    for (int w = 0; w < words_; ++w) {
      plane[static_cast<size_t>(w) * slots_] = keys[static_cast<size_t>(i) * words_ + w];
    }
  });
}

void AttentionCache::StoreRows(const uint32_t* keys, int slot) {
  const int blocks = slots_ / kWordSlots;
  const uint32_t bit = 1u << (slot % kWordSlots);
  ForEach(changed_, [&](int i) {
    for (int w = 0; w < words_; ++w) {
      uint32_t* const rows =
          Plane(keys_.number[i]) + slot / kWordSlots + static_cast<size_t>(kWordSlots) * w * blocks;
      uint32_t word = keys[static_cast<size_t>(i) * words_ + w];
      for (; word != 0; word &= word - 1) rows[std::countr_zero(word) * blocks] |= bit;
    }
  });
}

void AttentionCache::ClearRows(int slot) {
  const int blocks = slots_ / kWordSlots;
  changed_.assign(sets_, 0u);
  for (int i = 0; i < kWordSlots * sets_; ++i) {
    changed_[i % sets_] |= keys_.of_slot[static_cast<size_t>(slot) * sets_ + i];
  }
  ForEach(changed_, [&](int i) {
    uint32_t* const rows = Plane(keys_.number[i]) + slot / kWordSlots;
    for (int k = 0; k < kWordSlots * words_; ++k) rows[static_cast<size_t>(k) * blocks] = 0;
  });
}

int AttentionCache::NewPlane() {
  if (!free_.empty()) {
    const int number = free_.back();
    free_.pop_back();
    return number;
  }
  const size_t size = bits_.size();
  if (size == bits_.capacity()) bits_.reserve(size + size / 8 + 4 * plane_words_);
  bits_.resize(size + plane_words_, 0u);
  return static_cast<int>(size / plane_words_);
}

kernels::AttentionWindow AttentionCache::Shape() const {
  return {
      .ticks = ticks_, .heads = heads_, .head_size = head_size_, .words = words_, .slots = slots_};
}

kernels::AttentionWindow AttentionCache::Window(const AttentionBand& band) const {
  kernels::AttentionWindow window = Shape();
  window.bits = bits_.data();
  window.keys = keys_.number.data();
  window.values = values_.number.data();
  window.has_keys = keys_.exist.data();
  window.has_values = values_.exist.data();
  window.occupied = occupied_.data();
  window.valid = band.valid().data();
  return window;
}

uint64_t AttentionCache::ValueSpikes(const AttentionBand& band) const {
  return spikes_[band.last()].after - spikes_[band.first()].before;
}

}  // namespace spikeserve
