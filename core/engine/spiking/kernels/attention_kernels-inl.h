// The kernels of attention_kernels.h. Only float_kernels.cc may include it, which compiles it once
// per SIMD target.
#include <vector>

#include "core/engine/spiking/kernels/attention_kernels.h"
#include "core/engine/spiking/kernels/overlap-inl.h"
#include "core/engine/spiking/kernels/simd/vectors-inl.h"
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {
namespace {

// Returns the memory of this thread. Not inlined, because the compiler would compute the address
// again in every loop.
HWY_NOINLINE Scratch& ThreadScratch() {
  thread_local Scratch scratch;
  return scratch;
}

HWY_INLINE void Clear(float* values, int size) {
  const F32 d;
  int i = 0;
  for (; i + kVector <= size; i += kVector) hn::StoreU(hn::Zero(d), d, values + i);
  for (; i < size; ++i) values[i] = 0.0f;
}

// Computes attention at one tick and head at a time. `Keys` is KeyWords or KeyRows.
template <class Keys>
class HeadAttention {
 public:
  HeadAttention(const AttentionWindow& window, Scratch* scratch)
      : window_(window),
        blocks_(window.slots / kWordSlots),
        lanes_(kWordSlots * window.words),
        valid_count_(CountSlots(window.valid, blocks_)),
        keys_(window, scratch),
        group_(scratch->group.data()) {
    scratch->members.resize(blocks_);
    scratch->sums.resize(lanes_);
    members_ = scratch->members.data();
    sums_ = scratch->sums.data();
  }

  Keys& keys() { return keys_; }

  // Returns whether any valid slot has a value at tick and head number `index`. If none has, y is
  // zero for every query.
  bool HasValues(int index) const {
    const uint32_t* const occupied = Occupied(index);
    uint32_t any = 0;
    for (int b = 0; b < blocks_; ++b) any |= window_.valid[b] & occupied[b];
    return any != 0;
  }

  // Computes y if all overlaps are 0, so that all keys have equal weights.
  void AttendUniformly(int index, float* y) {
    Clear(sums_, lanes_);
    AddValues(index, window_.valid, 1.0f);
    Scale(1.0f / static_cast<float>(valid_count_), y);
  }

  // Computes y: for each distance from the best overlap to the worst, adds the value counts of the
  // slots at that distance times its weight. Returns the sum of the overlaps. REQUIRES: keys() has
  // the query.
  uint64_t Attend(int index, const float* weight, bool largest_is_best, float* y) {
    Clear(sums_, lanes_);
    keys_.Begin(largest_is_best);
    uint64_t products = 0;
    float total = 0.0f;
    int best = -1;
    for (int remaining = valid_count_; remaining > 0;) {
      int overlap = 0;
      const int count = keys_.Next(&overlap);
      if (best < 0) best = overlap;
      const float share = weight[largest_is_best ? best - overlap : overlap - best];
      remaining -= count;
      products += static_cast<uint64_t>(overlap) * count;
      total += share * static_cast<float>(count);
      AddValues(index, group_, share);
    }
    Scale(1.0f / total, y);
    return products;
  }

 private:
  const uint32_t* Occupied(int index) const {
    return window_.occupied + static_cast<size_t>(index) * blocks_;
  }

  // Adds to each sum `weight` times the number of `slots` that have its value bit.
  void AddValues(int index, const uint32_t* slots, float weight) {
    const F32 d;
    const uint32_t* const plane = window_.plane(window_.values[index]);
    const uint32_t* const occupied = Occupied(index);
    const auto add = [&](int lane, hn::Vec<U32> counts) HWY_ATTR {
      const auto share = hn::Mul(hn::Set(d, weight), hn::ConvertTo(d, hn::BitCast(I32(), counts)));
      hn::StoreU(hn::Add(hn::LoadU(d, sums_ + lane), share), d, sums_ + lane);
    };
    if constexpr (Keys::kLongRing) {
      // Skips the blocks without a value.
      int count = 0;
      for (int b = 0; b < blocks_; ++b) {
        members_[count] = {plane + static_cast<size_t>(b) * lanes_, slots[b]};
        count += (slots[b] & occupied[b]) != 0;
      }
      if (count == 0) return;
      for (int lane = 0; lane < lanes_; lane += kWordSlots) {
        hn::Vec<U32> counts[kVectorsPerWord];
        for (auto& each : counts) each = hn::Zero(U32());
        for (int i = 0; i < count; ++i) {
          const uint32_t* const values = members_[i].values + lane;
          const auto own = hn::Set(U32(), members_[i].slots);
          for (int v = 0; v < kVectorsPerWord; ++v) {
            const auto bits = hn::And(hn::LoadU(U32(), values + v * kVector), own);
            counts[v] = hn::Add(counts[v], hn::PopulationCount(bits));
          }
        }
        for (int v = 0; v < kVectorsPerWord; ++v) add(lane + v * kVector, counts[v]);
      }
    } else {
      uint32_t any = 0;
      for (int b = 0; b < blocks_; ++b) any |= slots[b] & occupied[b];
      if (any == 0) return;
      for (int lane = 0; lane < lanes_; lane += kVector) {
        add(lane, CountValues(blocks_, [&](int b) HWY_ATTR {
              const uint32_t* const values = plane + static_cast<size_t>(b) * lanes_ + lane;
              return hn::And(hn::LoadU(U32(), values), hn::Set(U32(), slots[b]));
            }));
      }
    }
  }

  // Returns the sum of the numbers of bits in the lanes of bits(0) ... bits(count - 1).
  template <class Bits>
  static HWY_INLINE hn::Vec<U32> CountValues(int count, Bits bits) {
    auto sum = hn::Zero(U32());
    for (int i = 0; i < count; ++i) sum = hn::Add(sum, hn::PopulationCount(bits(i)));
    return sum;
  }

  void Scale(float factor, float* y) const {
    const F32 d;
    int k = 0;
    for (; k + kVector <= window_.head_size; k += kVector) {
      hn::StoreU(hn::Mul(hn::LoadU(d, sums_ + k), hn::Set(d, factor)), d, y + k);
    }
    for (; k < window_.head_size; ++k) y[k] = sums_[k] * factor;
  }

  const AttentionWindow& window_;
  const int blocks_;
  const int lanes_;
  const int valid_count_;
  Keys keys_;
  const uint32_t* const group_;
  Members* members_;
  float* sums_;
};

HWY_INLINE bool HasBit(const uint64_t* bits, int i) { return (bits[i / 64] >> (i % 64) & 1u) != 0; }

// Calls visit(i) for every bit i that is set, ascending.
template <class Visit>
HWY_INLINE void ForEachBit(const uint64_t* bits, int size, Visit visit) {
  for (int first = 0; first < size; first += 64) {
    for (uint64_t word = bits[first / 64]; word != 0; word &= word - 1) {
      visit(first + __builtin_ctzll(word));
    }
  }
}

void FindNonzeroImpl(const uint32_t* bits, int ticks_and_heads, int words, uint64_t* nonzero) {
  const U32 du;
  for (int i = 0; i < ticks_and_heads; i += 64) nonzero[i / 64] = 0;
  int i = 0;
  for (; words == 1 && i + kVector <= ticks_and_heads; i += kVector) {
    const auto fires = hn::Ne(hn::LoadU(du, bits + i), hn::Zero(du));
    nonzero[i / 64] |= uint64_t{MaskBits(du, fires)} << (i % 64);
  }
  for (; i < ticks_and_heads; ++i) {
    uint32_t any = 0;
    for (int w = 0; w < words; ++w) any |= bits[static_cast<size_t>(i) * words + w];
    nonzero[i / 64] |= uint64_t{any != 0} << (i % 64);
  }
}

template <class Keys>
Attended AttendWith(const AttentionWindow& window, const uint32_t* query, const HeadScores& scores,
                    float* y) {
  Scratch& scratch = ThreadScratch();
  HeadAttention<Keys> attention(window, &scratch);
  const int size = window.ticks * window.heads;
  scratch.meeting.resize((size + 63) / 64);
  FindNonzeroImpl(query, size, window.words, scratch.meeting.data());
  for (size_t i = 0; i < scratch.meeting.size(); ++i) scratch.meeting[i] &= window.has_keys[i];
  Attended attended;
  for (int first = 0; first < size; first += window.heads) {  // the heads of a tick
    bool any_has_values = false;
    for (int head = 0; head < window.heads; ++head) {
      const int i = first + head;
      float* const head_y = y + static_cast<size_t>(head) * window.head_size;
      const bool has_values = HasBit(window.has_values, i) && attention.HasValues(i);
      const bool has_overlaps = HasBit(scratch.meeting.data(), i);
      if (has_overlaps) attention.keys().SetQuery(i, query + static_cast<size_t>(i) * window.words);
      if (!has_values) {
        Clear(head_y, window.head_size);
        if (has_overlaps) attended.products += attention.keys().Sum();
      } else if (!has_overlaps) {
        attention.AttendUniformly(i, head_y);
      } else {
        attended.products +=
            attention.Attend(i, scores.weight + static_cast<size_t>(head) * (window.head_size + 1),
                             scores.scale[head] >= 0.0f, head_y);
      }
      any_has_values |= has_values;
    }
    if (!any_has_values) continue;
    y += static_cast<size_t>(window.heads) * window.head_size;
    ++attended.ticks;
  }
  return attended;
}

Attended AttendImpl(const AttentionWindow& window, const uint32_t* query, const HeadScores& scores,
                    float* y) {
  return window.HasKeyRows() ? AttendWith<KeyRows>(window, query, scores, y)
                             : AttendWith<KeyWords>(window, query, scores, y);
}

void StoreValuesImpl(const uint32_t* bits, int slot, const AttentionWindow& window,
                     const uint64_t* changed, const int32_t* numbers, uint32_t* planes,
                     uint32_t* occupied) {
  const U32 du;
  const int blocks = window.slots / kWordSlots;
  const int lanes = kWordSlots * window.words;
  const uint32_t slot_bit = 1u << (slot % kWordSlots);
  const auto bit = hn::Set(du, slot_bit);
  occupied += slot / kWordSlots;
  planes += static_cast<size_t>(slot / kWordSlots) * lanes;
  ForEachBit(changed, window.ticks * window.heads, [&](int i) HWY_ATTR {
    const uint32_t* const own = bits + static_cast<size_t>(i) * window.words;
    uint32_t* const plane = planes + static_cast<size_t>(numbers[i]) * blocks * lanes;
    uint32_t any = 0;
    for (int lane = 0; lane < lanes; lane += kVector) {
      const uint32_t word = own[lane / kWordSlots];
      any |= word;
      const auto others = hn::AndNot(bit, hn::LoadU(du, plane + lane));
      const auto mine = hn::IfThenElseZero(MaskFromBits(du, word >> (lane % kWordSlots)), bit);
      hn::StoreU(hn::Or(others, mine), du, plane + lane);
    }
    uint32_t& block = occupied[static_cast<size_t>(i) * blocks];
    block = any != 0 ? block | slot_bit : block & ~slot_bit;
  });
}

}  // namespace
}  // namespace spikeserve::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace spikeserve::kernels {

HWY_EXPORT(AttendImpl);
HWY_EXPORT(FindNonzeroImpl);
HWY_EXPORT(StoreValuesImpl);

Attended Attend(const AttentionWindow& window, const uint32_t* query, const HeadScores& scores,
                float* y) {
  return HWY_DYNAMIC_DISPATCH(AttendImpl)(window, query, scores, y);
}

void FindNonzero(const uint32_t* bits, int ticks_and_heads, int words, uint64_t* nonzero) {
  HWY_DYNAMIC_DISPATCH(FindNonzeroImpl)(bits, ticks_and_heads, words, nonzero);
}

void StoreValues(const uint32_t* bits, int slot, const AttentionWindow& window,
                 const uint64_t* changed, const int32_t* numbers, uint32_t* planes,
                 uint32_t* occupied) {
  HWY_DYNAMIC_DISPATCH(StoreValuesImpl)(bits, slot, window, changed, numbers, planes, occupied);
}

}  // namespace spikeserve::kernels
#endif  // HWY_ONCE
