// Overlaps of the bits of a query with those of the keys of a window: kernels of attention.
// Compiled once per SIMD target; only attention_kernels-inl.h may include it.
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

#include "core/engine/spiking/kernels/attention_kernels.h"
#include "core/engine/spiking/kernels/simd/vectors-inl.h"
#include "hwy/highway.h"

// Highway's include guard, which admits this file once per target.
#if defined(CORE_ENGINE_SPIKING_KERNELS_OVERLAP_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef CORE_ENGINE_SPIKING_KERNELS_OVERLAP_INL_H_
#undef CORE_ENGINE_SPIKING_KERNELS_OVERLAP_INL_H_
#else
#define CORE_ENGINE_SPIKING_KERNELS_OVERLAP_INL_H_
#endif

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

}  // namespace
}  // namespace spikeserve::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif  // toggle
