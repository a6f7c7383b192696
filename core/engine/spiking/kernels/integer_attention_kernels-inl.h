// The kernels of integer_attention_kernels.h. Only integer_kernels.cc may include it, which
// compiles it once per SIMD target.
#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <numeric>

#include "core/engine/spiking/kernels/integer_attention_kernels.h"
#include "core/engine/spiking/kernels/simd/integer_vectors-inl.h"
#include "core/engine/spiking/kernels/simd/vectors-inl.h"
#include "core/math/fixed_point.h"
#include "core/model/fixed_point_weights.h"
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {
namespace {

// Vectors that rows of pairs consist of.
using Wide = hn::CappedTag<int32_t, 8>;
using Narrow = hn::Rebind<int16_t, Wide>;

constexpr int kPart = static_cast<int>(hn::MaxLanes(Wide()));

// Returns the pairs of a head that contain the values of the slot.
HWY_INLINE int16_t* PairsOf(const SlotValues& values, int head) {
  const size_t row = (static_cast<size_t>(head) * values.slots + values.slot) / 2;
  return reinterpret_cast<int16_t*>(values.pairs) + row * PairWidth(values.head_size);
}

// Loads `count` numbers, at most a vector, and zeros behind them.
HWY_INLINE hn::Vec<Narrow> LoadPart(const int16_t* numbers, int count) {
  const Narrow d;
  const auto part = hn::LoadU(d, numbers);
  return count >= kPart ? part : hn::IfThenElseZero(hn::FirstN(d, count), part);
}

// A slot's values lie at the bits from `shift` on of each pair.
template <int shift>
int StoreIn(const int16_t* counts, const SlotValues& values) {
  const Wide wide;
  const Narrow narrow;
  const auto neighbour = hn::Set(narrow, static_cast<int16_t>(shift == 0 ? 0xFF00 : 0x00FF));
  const int size = values.head_size;
  int32_t* sums = values.sums;
  int total = 0;
  for (int head = 0; head < values.heads; ++head, counts += size, sums += size) {
    int16_t* const pairs = PairsOf(values, head);
    int nonzero = 0;
    for (int k = 0; k < size; k += kPart) {
      const auto own = LoadPart(counts + k, size - k);
      nonzero += static_cast<int>(hn::CountTrue(narrow, hn::Ne(own, hn::Zero(narrow))));
      const auto kept = hn::And(hn::LoadU(narrow, pairs + k), neighbour);
      hn::StoreU(hn::Or(kept, hn::ShiftLeft<shift>(own)), narrow, pairs + k);
      const auto sum = hn::Add(hn::LoadU(wide, sums + k), hn::PromoteTo(wide, own));
      hn::StoreU(sum, wide, sums + k);
    }
    values.nonzero[head * values.slots + values.slot] = static_cast<int16_t>(nonzero);
    total += nonzero;
  }
  return total;
}

int StoreValuesImpl(const int16_t* counts, const SlotValues& values) {
  return values.slot % 2 == 0 ? StoreIn<0>(counts, values) : StoreIn<8>(counts, values);
}

template <int shift>
void RemoveFrom(const SlotValues& values) {
  const Wide wide;
  const auto byte = hn::Set(wide, 0xFF);
  const int size = values.head_size;
  int32_t* sums = values.sums;
  for (int head = 0; head < values.heads; ++head, sums += size) {
    const int16_t* const pairs = PairsOf(values, head);
    for (int k = 0; k < size; k += kPart) {
      const auto both = hn::PromoteTo(wide, LoadPart(pairs + k, size - k));
      const auto own = hn::And(hn::ShiftRight<shift>(both), byte);
      hn::StoreU(hn::Sub(hn::LoadU(wide, sums + k), own), wide, sums + k);
    }
  }
}

void RemoveValuesImpl(const SlotValues& values) {
  return values.slot % 2 == 0 ? RemoveFrom<0>(values) : RemoveFrom<8>(values);
}

using U8 = hn::Repartition<uint8_t, U32>;

// Returns the sum of the four bytes of each lane.
HWY_INLINE hn::Vec<U32> SumBytes(hn::Vec<U8> bytes) {
  const U32 d;
  const auto quads = hn::BitCast(d, bytes);
  const auto even = hn::Set(d, 0x00FF00FFu);
  const auto pairs = hn::Add(hn::And(quads, even), hn::And(hn::ShiftRight<8>(quads), even));
  return hn::Add(hn::And(pairs, hn::Set(d, 0xFFFFu)), hn::ShiftRight<16>(pairs));
}

uint64_t OverlapsImpl(const std::vector<QueryWord>& query, const HeadSlots& head,
                      const int32_t* held, int slots, int32_t* overlaps) {
  const U32 d;
  const U8 bytes;
  constexpr size_t kBytesFill = 31;  // words whose bits fit a byte
  auto sum = hn::Zero(d);
  const uint32_t* block = head.keys;
  for (int first = 0; first < slots; first += kSlotBlock, block += head.words * kSlotBlock) {
    for (int i = 0; i < kSlotBlock; i += kVector) {
      auto overlap = hn::Zero(d);
      for (size_t begin = 0; begin < query.size(); begin += kBytesFill) {
        const size_t end = std::min(query.size(), begin + kBytesFill);
        auto bits = hn::Zero(bytes);
        for (size_t n = begin; n < end; ++n) {
          const auto key = hn::LoadU(d, block + query[n].number * kSlotBlock + i);
          const auto both = hn::And(key, hn::Set(d, query[n].bits));
          bits = hn::Add(bits, hn::PopulationCount(hn::BitCast(bytes, both)));
        }
        overlap = hn::Add(overlap, SumBytes(bits));
      }
      const auto kept = hn::And(overlap, hn::BitCast(d, hn::LoadU(I32(), held + first + i)));
      hn::StoreU(hn::BitCast(I32(), kept), I32(), overlaps + first + i);
      sum = hn::Add(sum, kept);
    }
  }
  uint32_t lanes[kVector];
  hn::StoreU(sum, d, lanes);
  return std::accumulate(lanes, lanes + kVector, uint64_t{0});
}

// Returns the largest overlap of the slots that hold a token if `largest`, and the smallest one
// otherwise.
HWY_INLINE int32_t Best(bool largest, const int32_t* overlaps, const int32_t* held, int slots) {
  const I32 d;
  const auto worst = hn::Set(d, largest ? -1 : std::numeric_limits<int32_t>::max());
  auto best = worst;
  for (int i = 0; i < slots; i += kVector) {
    const auto is_held = hn::MaskFromVec(hn::LoadU(d, held + i));
    const auto next = hn::IfThenElse(is_held, hn::LoadU(d, overlaps + i), worst);
    best = largest ? hn::Max(best, next) : hn::Min(best, next);
  }
  return hn::GetLane(largest ? hn::MaxOfLanes(d, best) : hn::MinOfLanes(d, best));
}

// By how much the score of a key falls short of that of the best overlap.
class Shortfall {
 public:
  Shortfall(int32_t scale, const int32_t* overlaps, const int32_t* held, int slots)
      : overlaps_(overlaps),
        best_(hn::Set(I32(), Best(scale >= 0, overlaps, held, slots))),
        factor_(hn::Set(I32(), std::abs(scale))) {}

  // Returns those of the slots from `i` on, with kScaleFraction fraction bits. Farther overlaps
  // than 65535 have weight 0, too, unless the scale is 0; the product has 31 bits.
  HWY_INLINE VecI32 operator()(int i) const {
    const I32 d;
    const auto distance = hn::Abs(hn::Sub(hn::LoadU(d, overlaps_ + i), best_));
    return hn::Mul(hn::Min(distance, hn::Set(d, 65535)), factor_);
  }

 private:
  const int32_t* overlaps_;
  VecI32 best_;
  VecI32 factor_;
};

int32_t ShiftmaxImpl(int32_t scale, const int32_t* overlaps, const int32_t* held, int slots,
                     int16_t* weights) {
  const Shortfall shortfall(scale, overlaps, held, slots);
  const I32 d;
  const hn::Rebind<int16_t, I32> narrow;  // as many lanes as I32, in half a vector
  const auto rounding = hn::Set(d, 1 << (kScaleFraction - 1));
  auto sum = hn::Zero(d);
  for (int i = 0; i < slots; i += kVector) {
    const auto octaves = hn::ShiftRight<kScaleFraction>(hn::Add(shortfall(i), rounding));
    const auto weight =
        hn::And(hn::Shr(hn::Set(d, 256), hn::Min(octaves, hn::Set(d, 9))), hn::LoadU(d, held + i));
    sum = hn::Add(sum, weight);
    hn::StoreU(hn::DemoteTo(narrow, weight), narrow, weights + i);
  }
  return hn::GetLane(hn::SumOfLanes(d, sum));
}

// Returns whether a weight of the block of slots is not 0.
HWY_INLINE bool HasWeight(const int16_t* weights) {
  uint64_t words[kSlotBlock * sizeof(int16_t) / sizeof(uint64_t)];
  std::memcpy(words, weights, sizeof(words));
  uint64_t any = 0;
  for (const uint64_t word : words) any |= word;
  return any != 0;
}

// Sets sums[lane, lane + kVectors * kVector).
template <int kVectors>
HWY_INLINE void WeighLanes(const int16_t* weights, const HeadSlots& head, int slots, int lane,
                           int32_t* sums) {
  const I32 d;
  const hn::Rebind<uint8_t, I16> bytes;
  const size_t width = PairWidth(head.head_size);
  PairSum total[2][kVectors];  // of even and odd pairs, so that the chains of additions overlap
  for (int first = 0; first < slots; first += kSlotBlock) {
    if (!HasWeight(weights + first)) continue;
    const uint16_t* pairs = head.values + first / 2 * width + lane;
    for (int slot = first; slot < first + kSlotBlock; slot += 4) {
      for (int n = 0; n < 2; ++n, pairs += width) {
        int32_t both;
        std::memcpy(&both, weights + slot + 2 * n, sizeof(both));
        const auto weight = hn::BitCast(I16(), hn::Set(d, both));
        for (int v = 0; v < kVectors; ++v) {
          const auto* const counts = reinterpret_cast<const uint8_t*>(pairs + v * kVector);
          total[n][v].Add(hn::PromoteTo(I16(), hn::LoadU(bytes, counts)), weight);
        }
      }
    }
  }
  for (int v = 0; v < kVectors; ++v) {
    hn::StoreU(hn::Add(total[0][v].Total(), total[1][v].Total()), d, sums + lane + v * kVector);
  }
}

uint64_t WeighValuesImpl(const int16_t* weights, const HeadSlots& head, int slots, int32_t* sums) {
  int lane = 0;
  for (; lane + 3 * kVector < head.head_size; lane += 4 * kVector) {
    WeighLanes<4>(weights, head, slots, lane, sums);
  }
  for (; lane + kVector < head.head_size; lane += 2 * kVector) {
    WeighLanes<2>(weights, head, slots, lane, sums);
  }
  if (lane < head.head_size) WeighLanes<1>(weights, head, slots, lane, sums);
  const I32 d;
  const hn::Rebind<int16_t, I32> narrow;
  auto nonzero = hn::Zero(d);
  for (int i = 0; i < slots; i += kVector) {
    const auto has_weight = hn::Ne(hn::LoadU(narrow, weights + i), hn::Zero(narrow));
    const auto own = hn::IfThenElseZero(has_weight, hn::LoadU(narrow, head.nonzero + i));
    nonzero = hn::Add(nonzero, hn::PromoteTo(d, own));
  }
  return static_cast<uint64_t>(hn::GetLane(hn::SumOfLanes(d, nonzero)));
}

// Returns the sums / divisor, as ScaleSums. REQUIRES: 0 < divisor < 2^29.
HWY_INLINE VecI32 Scale(VecI32 sums, int32_t divisor) {
  const I32 d;
  const F32 f;
  // Float32 finds the quotient, at most 256, with an error of at most 1. The remainder, which lies
  // between -2 and 4 divisors, fits 32 bits, although its terms do not.
  const auto factor = hn::Set(f, static_cast<float>(1 << kGateFraction) / divisor);
  const auto near = hn::Add(hn::Mul(hn::ConvertTo(f, sums), factor), hn::Set(f, 0.5f));
  const auto quotient = hn::ConvertTo(d, near);
  const auto twice = hn::Set(d, 2 * divisor);
  const auto numerator = hn::Add(hn::ShiftLeft<kGateFraction + 1>(sums), hn::Set(d, divisor));
  const auto remainder = hn::Sub(numerator, hn::Mul(twice, quotient));
  const auto is_less = hn::BroadcastSignBit(remainder);  // -1 or 0
  const auto is_more = hn::VecFromMask(d, hn::Gt(remainder, hn::Set(d, 2 * divisor - 1)));
  const auto exact = hn::Sub(hn::Add(quotient, is_less), is_more);
  return hn::Min(exact, hn::Set(d, kLargestAttended));
}

void AddScaledImpl(const int16_t* y, int size, int32_t factor, int32_t* sums) {
  const I32 d;
  const hn::Rebind<int16_t, I32> narrow;
  int k = 0;
  for (; k + kVector <= size; k += kVector) {
    const auto product = hn::Mul(hn::PromoteTo(d, hn::LoadU(narrow, y + k)), hn::Set(d, factor));
    hn::StoreU(hn::Add(hn::LoadU(d, sums + k), product), d, sums + k);
  }
  for (; k < size; ++k) sums[k] += factor * y[k];
}

int ScaleSumsImpl(const int32_t* sums, int size, int32_t divisor, int16_t* y) {
  const I32 d;
  const hn::Rebind<int16_t, I32> narrow;
  int nonzero = 0;
  for (int k = 0; k < size; k += kVector) {
    const int count = std::min(size - k, kVector);
    const auto sum = hn::IfThenElseZero(hn::FirstN(d, count), hn::LoadU(d, sums + k));
    nonzero += static_cast<int>(hn::CountTrue(d, hn::Ne(sum, hn::Zero(d))));
    const auto scaled = hn::DemoteTo(narrow, Scale(sum, divisor));
    if (count == kVector) {
      hn::StoreU(scaled, narrow, y + k);
    } else {
      int16_t part[kVector];
      hn::StoreU(scaled, narrow, part);
      std::copy_n(part, count, y + k);
    }
  }
  return nonzero;
}

}  // namespace
}  // namespace spikeserve::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace spikeserve::kernels {

HWY_EXPORT(StoreValuesImpl);
HWY_EXPORT(RemoveValuesImpl);
HWY_EXPORT(OverlapsImpl);
HWY_EXPORT(ShiftmaxImpl);
HWY_EXPORT(WeighValuesImpl);
HWY_EXPORT(ScaleSumsImpl);
HWY_EXPORT(AddScaledImpl);

int StoreValues(const int16_t* counts, const SlotValues& values) {
  return HWY_DYNAMIC_DISPATCH(StoreValuesImpl)(counts, values);
}

void RemoveValues(const SlotValues& values) { HWY_DYNAMIC_DISPATCH(RemoveValuesImpl)(values); }

uint64_t Overlaps(const std::vector<QueryWord>& query, const HeadSlots& head, const int32_t* held,
                  int slots, int32_t* overlaps) {
  return HWY_DYNAMIC_DISPATCH(OverlapsImpl)(query, head, held, slots, overlaps);
}

int32_t Shiftmax(int32_t scale, const int32_t* overlaps, const int32_t* held, int slots,
                 int16_t* weights) {
  return HWY_DYNAMIC_DISPATCH(ShiftmaxImpl)(scale, overlaps, held, slots, weights);
}

uint64_t WeighValues(const int16_t* weights, const HeadSlots& head, int slots, int32_t* sums) {
  return HWY_DYNAMIC_DISPATCH(WeighValuesImpl)(weights, head, slots, sums);
}

void AddScaled(const int16_t* y, int size, int32_t factor, int32_t* sums) {
  HWY_DYNAMIC_DISPATCH(AddScaledImpl)(y, size, factor, sums);
}

int ScaleSums(const int32_t* sums, int size, int32_t divisor, int16_t* y) {
  if (divisor < 1 << 29) return HWY_DYNAMIC_DISPATCH(ScaleSumsImpl)(sums, size, divisor, y);
  int nonzero = 0;
  for (int k = 0; k < size; ++k) {
    const int64_t scaled = RoundDivide(int64_t{sums[k]} << kGateFraction, divisor);
    y[k] = static_cast<int16_t>(std::min<int64_t>(scaled, kLargestAttended));
    nonzero += sums[k] != 0;
  }
  return nonzero;
}

}  // namespace spikeserve::kernels
#endif  // HWY_ONCE
