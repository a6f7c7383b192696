#include "core/engine/spiking/kernels/attention_kernels.h"

#include <vector>

#define HWY_WANT_AVX3_DL 1
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/engine/spiking/kernels/attention_kernels.cc"
// clang-format off
#include "hwy/foreach_target.h"  // must come first: compiles the rest of this file once per target
// clang-format on
#include "core/engine/spiking/kernels/simd-inl.h"
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {
namespace {

// Sets overlaps[slot] = popcount(q & k) for all slots at one tick and head; keys [W][S].
HWY_INLINE void Overlaps(const uint32_t* keys, const uint32_t* query, int words, int slots,
                         uint32_t* overlaps) {
  const U32 du;
  for (int slot = 0; slot < slots; slot += kVector) {
    auto total = hn::Zero(du);
    for (int w = 0; w < words; ++w) {
      const auto key = hn::LoadU(du, keys + static_cast<size_t>(w) * slots + slot);
      total = hn::Add(total, hn::PopulationCount(hn::And(key, hn::Set(du, query[w]))));
    }
    hn::StoreU(total, du, overlaps + slot);
  }
}

// Returns the slots of one 32-slot block whose overlap is `overlap`, as bits.
HWY_INLINE uint32_t SlotsAt(const uint32_t* overlaps, uint32_t overlap) {
  const U32 du;
  uint32_t mask = 0;
  for (int v = 0; v < kVectorsPerWord; ++v) {
    const auto equal = hn::Eq(hn::LoadU(du, overlaps + v * kVector), hn::Set(du, overlap));
    mask |= MaskBits(du, equal) << (v * kVector);
  }
  return mask;
}

// Returns, for each of the value bits `lane` ... `lane` + kVector - 1, how many of the slots in
// `members` [blocks] have it; values [blocks][lanes].
HWY_INLINE VecF CountValues(const uint32_t* values, const uint32_t* members, int blocks, int lanes,
                            int lane) {
  const I32 di;
  const U32 du;
  auto count = hn::Zero(du);
  for (int b = 0; b < blocks; ++b) {
    const auto bits = hn::LoadU(du, values + static_cast<size_t>(b) * lanes + lane);
    count = hn::Add(count, hn::PopulationCount(hn::And(bits, hn::Set(du, members[b]))));
  }
  return hn::ConvertTo(F32(), hn::BitCast(di, count));
}

// Returns whether any of `count` words has a bit set.
HWY_INLINE bool AnyBit(const uint32_t* words, int count) {
  uint32_t any = 0;
  for (int i = 0; i < count; ++i) any |= words[i];
  return any != 0;
}

HWY_INLINE void Clear(float* values, int size) {
  const F32 d;
  int i = 0;
  for (; i + kVector <= size; i += kVector) hn::StoreU(hn::Zero(d), d, values + i);
  for (; i < size; ++i) values[i] = 0.0f;
}

// Computes attention at one tick and head at a time. `scratch` has room for S overlaps, followed by
// S / 32 words of members; `sums` has room for 32 W sums.
class HeadAttention {
 public:
  HeadAttention(const AttentionWindow& window, uint32_t* scratch, float* sums)
      : window_(window),
        blocks_(window.slots / 32),
        lanes_(32 * window.words),
        valid_count_(Count(window.valid)),
        overlaps_(scratch),
        members_(scratch + window.slots),
        sums_(sums) {}

  // Selects the tick and head with number `index` in the window.
  void MoveTo(int index) {
    keys_ = window_.keys + static_cast<size_t>(index) * window_.words * window_.slots;
    values_ = window_.values + static_cast<size_t>(index) * blocks_ * lanes_;
    occupied_ = window_.occupied + static_cast<size_t>(index) * blocks_;
  }

  // Returns whether any valid slot has a value at this tick and head. If none has, y is zero for
  // every query.
  bool HasValues() const { return MeetsOccupied(window_.valid); }

  // Computes y for a query without spikes: all overlaps are 0, so all keys have equal weights.
  void AttendUniformly(float* y) {
    const F32 d;
    for (int lane = 0; lane < lanes_; lane += kVector) {
      hn::StoreU(CountValues(values_, window_.valid, blocks_, lanes_, lane), d, sums_ + lane);
    }
    Scale(1.0f / static_cast<float>(valid_count_), y);
  }

  // Computes y: for each distance from the best overlap to the worst, adds the value counts of the
  // slots at that distance times its weight. Returns the sum of the overlaps.
  uint64_t Attend(const uint32_t* query, const float* weight, bool largest_is_best, float* y) {
    const F32 d;
    Overlaps(keys_, query, window_.words, window_.slots, overlaps_);
    Clear(sums_, lanes_);
    const uint32_t best = largest_is_best ? HighestOverlap() : LowestOverlap();
    uint64_t products = 0;
    float total = 0.0f;
    int remaining = valid_count_;
    for (uint32_t distance = 0; remaining > 0; ++distance) {
      const uint32_t overlap = largest_is_best ? best - distance : best + distance;
      const int count = FindMembers(overlap);
      if (count == 0) continue;
      remaining -= count;
      products += static_cast<uint64_t>(overlap) * count;
      total += weight[distance] * static_cast<float>(count);
      if (!MeetsOccupied(members_)) continue;
      for (int lane = 0; lane < lanes_; lane += kVector) {
        const auto share = hn::Mul(hn::Set(d, weight[distance]),
                                   CountValues(values_, members_, blocks_, lanes_, lane));
        hn::StoreU(hn::Add(hn::LoadU(d, sums_ + lane), share), d, sums_ + lane);
      }
    }
    Scale(1.0f / total, y);
    return products;
  }

  // Returns the sum of the overlaps of the valid slots.
  uint64_t SumOverlaps(const uint32_t* query) {
    Overlaps(keys_, query, window_.words, window_.slots, overlaps_);
    const U32 du;
    auto sum = hn::Zero(du);
    for (int slot = 0; slot < window_.slots; slot += kVector) {
      sum = hn::Add(sum, hn::IfThenElseZero(Valid(slot), hn::LoadU(du, overlaps_ + slot)));
    }
    return hn::GetLane(hn::SumOfLanes(du, sum));
  }

 private:
  void Scale(float factor, float* y) const {
    const F32 d;
    int k = 0;
    for (; k + kVector <= window_.head_size; k += kVector) {
      hn::StoreU(hn::Mul(hn::LoadU(d, sums_ + k), hn::Set(d, factor)), d, y + k);
    }
    for (; k < window_.head_size; ++k) y[k] = sums_[k] * factor;
  }

  int Count(const uint32_t* slots) const {
    int count = 0;
    for (int b = 0; b < blocks_; ++b) count += __builtin_popcount(slots[b]);
    return count;
  }

  bool MeetsOccupied(const uint32_t* slots) const {
    uint32_t any = 0;
    for (int b = 0; b < blocks_; ++b) any |= slots[b] & occupied_[b];
    return any != 0;
  }

  // Writes the valid slots whose overlap is `overlap` to members_. Returns their number.
  int FindMembers(uint32_t overlap) {
    for (int b = 0; b < blocks_; ++b) {
      members_[b] = window_.valid[b] & SlotsAt(overlaps_ + 32 * b, overlap);
    }
    return Count(members_);
  }

  hn::Mask<U32> Valid(int slot) const {
    return MaskFromBits(U32(), window_.valid[slot / 32] >> (slot % 32));
  }

  // Returns the smallest overlap of a valid slot.
  uint32_t LowestOverlap() const {
    const U32 du;
    auto low = hn::Set(du, ~0u);
    for (int slot = 0; slot < window_.slots; slot += kVector) {
      const auto overlap = hn::LoadU(du, overlaps_ + slot);
      low = hn::Min(low, hn::IfThenElse(Valid(slot), overlap, hn::Set(du, ~0u)));
    }
    return hn::GetLane(hn::MinOfLanes(du, low));
  }

  // Returns the largest overlap of a valid slot.
  uint32_t HighestOverlap() const {
    const U32 du;
    auto high = hn::Zero(du);
    for (int slot = 0; slot < window_.slots; slot += kVector) {
      high = hn::Max(high, hn::IfThenElseZero(Valid(slot), hn::LoadU(du, overlaps_ + slot)));
    }
    return hn::GetLane(hn::MaxOfLanes(du, high));
  }

  const AttentionWindow& window_;
  const int blocks_;
  const int lanes_;
  const int valid_count_;
  const uint32_t* keys_ = nullptr;      // of the selected tick and head
  const uint32_t* values_ = nullptr;    // of the selected tick and head
  const uint32_t* occupied_ = nullptr;  // of the selected tick and head
  uint32_t* overlaps_;
  uint32_t* members_;
  float* sums_;
};

Attended AttendImpl(const AttentionWindow& window, const uint32_t* query, const float* weight,
                    const float* scale, float* y) {
  thread_local std::vector<uint32_t> scratch;
  thread_local std::vector<float> sums;
  scratch.resize(window.slots + window.slots / 32);
  sums.resize(32 * window.words);
  HeadAttention attention(window, scratch.data(), sums.data());
  Attended attended;
  for (int tick = 0; tick < window.ticks; ++tick) {
    bool any_has_values = false;
    for (int head = 0; head < window.heads; ++head) {
      attention.MoveTo(tick * window.heads + head);
      float* const head_y = y + static_cast<size_t>(head) * window.head_size;
      const bool has_values = attention.HasValues();
      const bool query_fires = AnyBit(query, window.words);
      if (!has_values) {
        Clear(head_y, window.head_size);
        if (query_fires) attended.products += attention.SumOverlaps(query);
      } else if (!query_fires) {
        attention.AttendUniformly(head_y);
      } else {
        attended.products +=
            attention.Attend(query, weight + static_cast<size_t>(head) * (window.head_size + 1),
                             scale[head] >= 0.0f, head_y);
      }
      any_has_values |= has_values;
      query += window.words;
    }
    if (!any_has_values) continue;
    y += static_cast<size_t>(window.heads) * window.head_size;
    ++attended.ticks;
  }
  return attended;
}

void StoreValuesImpl(const uint32_t* bits, int slot, const AttentionWindow& window,
                     uint32_t* values, uint32_t* occupied) {
  const U32 du;
  const int blocks = window.slots / 32;
  const int lanes = 32 * window.words;
  const uint32_t slot_bit = 1u << (slot % 32);
  const auto bit = hn::Set(du, slot_bit);
  occupied += slot / 32;
  values += static_cast<size_t>(slot / 32) * lanes;
  for (int i = 0; i < window.ticks * window.heads; ++i) {
    const bool occupies = AnyBit(bits, window.words);
    // Otherwise the slot has no value bit before and after.
    if (occupies || (*occupied & slot_bit) != 0) {
      *occupied = occupies ? *occupied | slot_bit : *occupied & ~slot_bit;
      for (int lane = 0; lane < lanes; lane += kVector) {
        const auto others = hn::AndNot(bit, hn::LoadU(du, values + lane));
        const auto own = hn::IfThenElseZero(MaskFromBits(du, bits[lane / 32] >> (lane % 32)), bit);
        hn::StoreU(hn::Or(others, own), du, values + lane);
      }
    }
    bits += window.words;
    occupied += blocks;
    values += static_cast<size_t>(blocks) * lanes;
  }
}

}  // namespace
}  // namespace spikeserve::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace spikeserve::kernels {

HWY_EXPORT(AttendImpl);
HWY_EXPORT(StoreValuesImpl);

Attended Attend(const AttentionWindow& window, const uint32_t* query, const float* weight,
                const float* scale, float* y) {
  return HWY_DYNAMIC_DISPATCH(AttendImpl)(window, query, weight, scale, y);
}

void StoreValues(const uint32_t* bits, int slot, const AttentionWindow& window, uint32_t* values,
                 uint32_t* occupied) {
  HWY_DYNAMIC_DISPATCH(StoreValuesImpl)(bits, slot, window, values, occupied);
}

}  // namespace spikeserve::kernels
#endif  // HWY_ONCE
