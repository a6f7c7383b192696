#include "core/engine/kernels/attention_kernels.h"

#include <algorithm>
#include <utility>
#include <vector>

#define HWY_WANT_AVX3_DL 1
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/engine/kernels/attention_kernels.cc"
// clang-format off
#include "hwy/foreach_target.h"  // must come first: compiles what follows once per target
// clang-format on
#include "core/engine/kernels/simd-inl.h"
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {
namespace {

// overlaps[slot] = popcount(q & k) of one tick and head; keys [W][S].
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

// The slots of one 32-slot block whose overlap is `overlap`, as bits.
HWY_INLINE uint32_t SlotsAt(const uint32_t* overlaps, uint32_t overlap) {
  const U32 du;
  uint32_t mask = 0;
  for (int v = 0; v < kVectorsPerWord; ++v) {
    const auto equal = hn::Eq(hn::LoadU(du, overlaps + v * kVector), hn::Set(du, overlap));
    mask |= MaskBits(du, equal) << (v * kVector);
  }
  return mask;
}

// How many of the slots in `members` [blocks] have value bit `lane` ... `lane` + kVector - 1;
// values [blocks][lanes].
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

// Attention of one tick and head after the other. `scratch` has room for S overlaps, then S / 32
// words of members; `sums` for 32 W sums.
class HeadAttention {
 public:
  HeadAttention(const AttentionWindow& window, uint32_t* scratch, float* sums)
      : window_(window),
        blocks_(window.slots / 32),
        lanes_(32 * window.words),
        valid_count_(CountMembers(window.valid)),
        overlaps_(scratch),
        members_(scratch + window.slots),
        sums_(sums) {}

  // Returns the sum of overlaps.
  uint64_t Run(const uint32_t* keys, const uint32_t* values, const uint32_t* query,
               const float* weight, bool largest_is_best, float* y) {
    const F32 d;
    const bool silent =
        std::all_of(query, query + window_.words, [](uint32_t word) { return word == 0; });
    float total = static_cast<float>(valid_count_);
    uint64_t products = 0;
    if (silent) {
      for (int lane = 0; lane < lanes_; lane += kVector) {
        hn::StoreU(CountValues(values, window_.valid, blocks_, lanes_, lane), d, sums_ + lane);
      }
    } else {
      std::fill_n(sums_, lanes_, 0.0f);
      products = AddGroups(keys, values, query, weight, largest_is_best, &total);
    }
    const float inverse = 1.0f / total;
    int k = 0;
    for (; k + kVector <= window_.head_size; k += kVector) {
      hn::StoreU(hn::Mul(hn::LoadU(d, sums_ + k), hn::Set(d, inverse)), d, y + k);
    }
    for (; k < window_.head_size; ++k) y[k] = sums_[k] * inverse;
    return products;
  }

 private:
  // Adds up the values of each group of slots with one overlap, times the group's weight, from the
  // best overlap to the worst.
  uint64_t AddGroups(const uint32_t* keys, const uint32_t* values, const uint32_t* query,
                     const float* weight, bool largest_is_best, float* total) {
    const F32 d;
    Overlaps(keys, query, window_.words, window_.slots, overlaps_);
    const auto [lowest, highest] = Range();
    uint64_t products = 0;
    int remaining = valid_count_;
    *total = 0.0f;
    for (uint32_t distance = 0; remaining > 0; ++distance) {
      const uint32_t overlap = largest_is_best ? highest - distance : lowest + distance;
      const int count = Members(overlap);
      if (count == 0) continue;
      remaining -= count;
      products += static_cast<uint64_t>(overlap) * count;
      *total += weight[distance] * static_cast<float>(count);
      for (int lane = 0; lane < lanes_; lane += kVector) {
        const auto share = hn::Mul(hn::Set(d, weight[distance]),
                                   CountValues(values, members_, blocks_, lanes_, lane));
        hn::StoreU(hn::Add(hn::LoadU(d, sums_ + lane), share), d, sums_ + lane);
      }
    }
    return products;
  }

  int CountMembers(const uint32_t* members) const {
    int count = 0;
    for (int b = 0; b < blocks_; ++b) count += __builtin_popcount(members[b]);
    return count;
  }

  // Collects the valid slots at this overlap.
  int Members(uint32_t overlap) {
    for (int b = 0; b < blocks_; ++b) {
      members_[b] = window_.valid[b] & SlotsAt(overlaps_ + 32 * b, overlap);
    }
    return CountMembers(members_);
  }

  // The lowest and the highest overlap among the valid slots.
  std::pair<uint32_t, uint32_t> Range() const {
    const U32 du;
    auto low = hn::Set(du, ~0u);
    auto high = hn::Zero(du);
    for (int slot = 0; slot < window_.slots; slot += kVector) {
      const auto valid = MaskFromBits(du, window_.valid[slot / 32] >> (slot % 32));
      const auto overlap = hn::LoadU(du, overlaps_ + slot);
      low = hn::Min(low, hn::IfThenElse(valid, overlap, hn::Set(du, ~0u)));
      high = hn::Max(high, hn::IfThenElseZero(valid, overlap));
    }
    return {hn::GetLane(hn::MinOfLanes(du, low)), hn::GetLane(hn::MaxOfLanes(du, high))};
  }

  const AttentionWindow& window_;
  const int blocks_;
  const int lanes_;
  const int valid_count_;
  uint32_t* overlaps_;
  uint32_t* members_;
  float* sums_;
};

uint64_t AttendImpl(const AttentionWindow& window, const uint32_t* query, const float* weight,
                    const float* scale, float* y) {
  thread_local std::vector<uint32_t> scratch;
  thread_local std::vector<float> sums;
  const int blocks = window.slots / 32;
  scratch.resize(window.slots + blocks);
  sums.resize(32 * window.words);
  HeadAttention head_attention(window, scratch.data(), sums.data());
  uint64_t products = 0;
  for (int i = 0; i < window.ticks * window.heads; ++i) {
    const int head = i % window.heads;
    products +=
        head_attention.Run(window.keys + static_cast<size_t>(i) * window.words * window.slots,
                           window.values + static_cast<size_t>(i) * blocks * 32 * window.words,
                           query + static_cast<size_t>(i) * window.words,
                           weight + static_cast<size_t>(head) * (window.head_size + 1),
                           scale[head] >= 0.0f, y + static_cast<size_t>(i) * window.head_size);
  }
  return products;
}

void StoreValuesImpl(const uint32_t* bits, int slot, const AttentionWindow& window,
                     uint32_t* values) {
  const U32 du;
  const int blocks = window.slots / 32;
  const int lanes = 32 * window.words;
  const auto bit = hn::Set(du, 1u << (slot % 32));
  for (int i = 0; i < window.ticks * window.heads; ++i) {
    uint32_t* block = values + (static_cast<size_t>(i) * blocks + slot / 32) * lanes;
    for (int lane = 0; lane < lanes; lane += kVector) {
      const uint32_t word = bits[static_cast<size_t>(i) * window.words + lane / 32] >> (lane % 32);
      const auto others = hn::AndNot(bit, hn::LoadU(du, block + lane));
      const auto own = hn::IfThenElseZero(MaskFromBits(du, word), bit);
      hn::StoreU(hn::Or(others, own), du, block + lane);
    }
  }
}

}  // namespace
}  // namespace spikeserve::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace spikeserve::kernels {

HWY_EXPORT(AttendImpl);
HWY_EXPORT(StoreValuesImpl);

uint64_t Attend(const AttentionWindow& window, const uint32_t* query, const float* weight,
                const float* scale, float* y) {
  return HWY_DYNAMIC_DISPATCH(AttendImpl)(window, query, weight, scale, y);
}

void StoreValues(const uint32_t* bits, int slot, const AttentionWindow& window, uint32_t* values) {
  HWY_DYNAMIC_DISPATCH(StoreValuesImpl)(bits, slot, window, values);
}

}  // namespace spikeserve::kernels
#endif  // HWY_ONCE
