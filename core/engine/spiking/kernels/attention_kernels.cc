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

constexpr int kWordSlots = 32;

// A block of 32 slots, and those of its slots whose values are counted together.
struct Members {
  const uint32_t* values;  // [32 W]
  uint32_t slots;
};

// Memory of one thread, reused by its calls.
struct Scratch {
  std::vector<uint64_t> meeting;      // bit i: number i of [T][H] has query bits and key bits
  std::vector<const uint32_t*> rows;  // the rows of the keys that a query has bits of
  std::vector<uint32_t> overlaps;     // see KeyWords and KeyRows
  std::vector<uint32_t> remaining;    // [S / 32]: valid slots that belong to no group yet
  std::vector<uint32_t> group;        // [S / 32]: valid slots of equal overlap
  std::vector<Members> members;       // [S / 32]
  std::vector<float> sums;            // [32 W]
};

// Returns the memory of this thread. Not inlined, because the compiler would compute the address
// again in every loop.
HWY_NOINLINE Scratch& ThreadScratch() {
  thread_local Scratch scratch;
  return scratch;
}

// Returns the number of bits set in words[0, count). `count` is even.
HWY_INLINE int CountSlots(const uint32_t* words, int count) {
  int slots = 0;
  for (int i = 0; i < count; i += 2) {
    uint64_t both;
    std::memcpy(&both, words + i, sizeof(both));
    slots += __builtin_popcountll(both);
  }
  return slots;
}

HWY_INLINE void Clear(float* values, int size) {
  const F32 d;
  int i = 0;
  for (; i + kVector <= size; i += kVector) hn::StoreU(hn::Zero(d), d, values + i);
  for (; i < size; ++i) values[i] = 0.0f;
}

// Overlaps of a query with keys whose words are dimensions, [W][S]: one population count a slot.
class KeyWords {
 public:
  static constexpr bool kLongRing = false;

  KeyWords(const AttentionWindow& window, Scratch* scratch) : window_(window) {
    scratch->overlaps.resize(window.slots);
    scratch->group.resize(window.slots / kWordSlots);
    overlaps_ = scratch->overlaps.data();
    group_ = scratch->group.data();
  }

  // Computes the overlaps of a query with the keys at tick and head number `index`.
  void SetQuery(int index, const uint32_t* query) {
    const U32 du;
    const uint32_t* const keys = window_.plane(window_.keys[index]);
    for (int slot = 0; slot < window_.slots; slot += kVector) {
      auto total = hn::Zero(du);
      for (int w = 0; w < window_.words; ++w) {
        const auto key = hn::LoadU(du, keys + static_cast<size_t>(w) * window_.slots + slot);
        total = hn::Add(total, hn::PopulationCount(hn::And(key, hn::Set(du, query[w]))));
      }
      hn::StoreU(total, du, overlaps_ + slot);
    }
  }

  // Returns the sum of the overlaps of the valid slots.
  uint64_t Sum() const {
    const U32 du;
    auto sum = hn::Zero(du);
    for (int slot = 0; slot < window_.slots; slot += kVector) {
      sum = hn::Add(sum, hn::IfThenElseZero(Valid(slot), At(slot)));
    }
    return hn::GetLane(hn::SumOfLanes(du, sum));
  }

  // Moves before the group of valid slots with the best overlap.
  void Begin(bool largest_is_best) {
    step_ = largest_is_best ? -1 : 1;
    next_ = largest_is_best ? Highest() : Lowest();
  }

  // Sets `group` of the scratch memory to the next group, and `overlap` to the overlap of its
  // slots. Returns the number of its slots. REQUIRES: not all valid slots were in a group.
  int Next(int* overlap) {
    const int blocks = window_.slots / kWordSlots;
    int count = 0;
    while (count == 0) {
      for (int b = 0; b < blocks; ++b) {
        const uint32_t slots = window_.valid[b] & SlotsAt(kWordSlots * b, next_);
        group_[b] = slots;
        count += __builtin_popcount(slots);
      }
      *overlap = next_;
      next_ += step_;
    }
    return count;
  }

 private:
  hn::Vec<U32> At(int slot) const { return hn::LoadU(U32(), overlaps_ + slot); }

  hn::Mask<U32> Valid(int slot) const {
    return MaskFromBits(U32(), window_.valid[slot / kWordSlots] >> (slot % kWordSlots));
  }

  // Returns the slots of the block at `slot` whose overlap is `overlap`, as bits.
  uint32_t SlotsAt(int slot, int overlap) const {
    const U32 du;
    uint32_t mask = 0;
    for (int v = 0; v < kVectorsPerWord; ++v) {
      const auto equal =
          hn::Eq(At(slot + v * kVector), hn::Set(du, static_cast<uint32_t>(overlap)));
      mask |= MaskBits(du, equal) << (v * kVector);
    }
    return mask;
  }

  // Returns the smallest overlap of a valid slot.
  int Lowest() const {
    const U32 du;
    auto low = hn::Set(du, ~0u);
    for (int slot = 0; slot < window_.slots; slot += kVector) {
      low = hn::Min(low, hn::IfThenElse(Valid(slot), At(slot), hn::Set(du, ~0u)));
    }
    return static_cast<int>(hn::GetLane(hn::MinOfLanes(du, low)));
  }

  // Returns the largest overlap of a valid slot.
  int Highest() const {
    const U32 du;
    auto high = hn::Zero(du);
    for (int slot = 0; slot < window_.slots; slot += kVector) {
      high = hn::Max(high, hn::IfThenElseZero(Valid(slot), At(slot)));
    }
    return static_cast<int>(hn::GetLane(hn::MaxOfLanes(du, high)));
  }

  const AttentionWindow& window_;
  uint32_t* overlaps_;  // [S]
  uint32_t* group_;
  int next_ = 0;  // overlap
  int step_ = 0;
};

// Overlaps of a query with keys whose words are slots, [32 W][S / 32]. Reads only the rows of the
// query's bits and adds them bit by bit, for a whole vector of slots at once.
class KeyRows {
 public:
  static constexpr bool kLongRing = true;

  KeyRows(const AttentionWindow& window, Scratch* scratch)
      : window_(window), blocks_(window.slots / kWordSlots), scratch_(*scratch) {
    scratch_.remaining.resize(blocks_);
    scratch_.group.resize(blocks_);
    remaining_ = scratch_.remaining.data();
    group_ = scratch_.group.data();
  }

  // Selects the rows of the bits of `query` at tick and head number `index`. REQUIRES: it has one.
  void SetQuery(int index, const uint32_t* query) {
    const uint32_t* const keys = window_.plane(window_.keys[index]);
    scratch_.rows.clear();
    for (int w = 0; w < window_.words; ++w) {
      for (uint32_t bits = query[w]; bits != 0; bits &= bits - 1) {
        const int bit = kWordSlots * w + __builtin_ctz(bits);
        scratch_.rows.push_back(keys + static_cast<size_t>(bit) * blocks_);
      }
    }
  }

  // The methods below are those of KeyWords.
  uint64_t Sum() const {
    const D d;
    auto sum = hn::Zero(d);
    for (const uint32_t* row : scratch_.rows) {
      for (int b = 0; b < blocks_; b += kStep) {
        const auto slots = hn::And(hn::LoadU(d, row + b), hn::LoadU(d, window_.valid + b));
        sum = hn::Add(sum, hn::PopulationCount(slots));
      }
    }
    return hn::GetLane(hn::SumOfLanes(d, sum));
  }

  void Begin(bool largest_is_best) {
    largest_is_best_ = largest_is_best;
    std::memcpy(remaining_, window_.valid, blocks_ * sizeof(uint32_t));
    const auto rows = static_cast<unsigned>(scratch_.rows.size());
    overlap_bits_ = 32 - __builtin_clz(rows);
    const size_t size = static_cast<size_t>(overlap_bits_) * blocks_;
    if (scratch_.overlaps.size() < size) scratch_.overlaps.resize(size);
    overlaps_ = scratch_.overlaps.data();
    if (rows == 1) return AddRows<1>();
    if (rows <= 3) return AddRows<2>();
    if (rows <= 7) return AddRows<3>();
    if (rows <= 15) return AddRows<4>();
    if (rows <= 31) return AddRows<5>();
    AddRows<kMostBits>();
  }

  int Next(int* overlap) {
    const D d;
    *overlap = 0;
    std::memcpy(group_, remaining_, blocks_ * sizeof(uint32_t));
    for (int k = overlap_bits_ - 1; k >= 0; --k) {
      // Of the slots that are left, those with the better value of this bit stay, if there are any.
      const auto worse = largest_is_best_ ? hn::Zero(d) : hn::Set(d, ~0u);
      const uint32_t* const bits = Overlaps(k);
      auto any = hn::Zero(d);
      for (int b = 0; b < blocks_; b += kStep) {
        any =
            hn::Or(any, hn::And(hn::LoadU(d, group_ + b), hn::Xor(hn::LoadU(d, bits + b), worse)));
      }
      const bool exists = !hn::AllTrue(d, hn::Eq(any, hn::Zero(d)));
      *overlap |= static_cast<int>(exists == largest_is_best_) << k;
      if (!exists) continue;
      for (int b = 0; b < blocks_; b += kStep) {
        const auto better = hn::Xor(hn::LoadU(d, bits + b), worse);
        hn::StoreU(hn::And(hn::LoadU(d, group_ + b), better), d, group_ + b);
      }
    }
    for (int b = 0; b < blocks_; b += kStep) {
      const auto left = hn::AndNot(hn::LoadU(d, group_ + b), hn::LoadU(d, remaining_ + b));
      hn::StoreU(left, d, remaining_ + b);
    }
    return CountSlots(group_, blocks_);
  }

 private:
  using D = U32;  // of vectors of slots
  static constexpr int kStep = kVector;
  static constexpr int kMostBits = 24;  // of an overlap, which is at most d_h

  // Counts the rows that have each slot in kBits bits, of which it stores overlap_bits_.
  template <int kBits>
  HWY_INLINE void AddRows() {
    const D d;
    for (int b = 0; b < blocks_; b += kStep) {
      hn::Vec<D> sum[kBits];
      for (auto& bit : sum) bit = hn::Zero(d);
      for (const uint32_t* row : scratch_.rows) {
        auto carry = hn::LoadU(d, row + b);
        for (auto& bit : sum) {
          const auto next = hn::And(bit, carry);
          bit = hn::Xor(bit, carry);
          carry = next;
        }
      }
      for (int k = 0; k < overlap_bits_; ++k) hn::StoreU(sum[k], d, Overlaps(k) + b);
    }
  }

  uint32_t* Overlaps(int bit) { return overlaps_ + static_cast<size_t>(bit) * blocks_; }

  const AttentionWindow& window_;
  const int blocks_;
  Scratch& scratch_;
  uint32_t* overlaps_ = nullptr;  // [bits][S / 32]: bit k of the overlaps of the slots
  uint32_t* remaining_;
  uint32_t* group_;
  int overlap_bits_ = 0;
  bool largest_is_best_ = true;
};

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
Attended AttendWith(const AttentionWindow& window, const uint32_t* query, const float* weight,
                    const float* scale, float* y) {
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
            attention.Attend(i, weight + static_cast<size_t>(head) * (window.head_size + 1),
                             scale[head] >= 0.0f, head_y);
      }
      any_has_values |= has_values;
    }
    if (!any_has_values) continue;
    y += static_cast<size_t>(window.heads) * window.head_size;
    ++attended.ticks;
  }
  return attended;
}

Attended AttendImpl(const AttentionWindow& window, const uint32_t* query, const float* weight,
                    const float* scale, float* y) {
  return window.HasKeyRows() ? AttendWith<KeyRows>(window, query, weight, scale, y)
                             : AttendWith<KeyWords>(window, query, weight, scale, y);
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

Attended Attend(const AttentionWindow& window, const uint32_t* query, const float* weight,
                const float* scale, float* y) {
  return HWY_DYNAMIC_DISPATCH(AttendImpl)(window, query, weight, scale, y);
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
