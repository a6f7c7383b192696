// Defines types and small helpers for the kernels of 16-bit integers. Compiled once per SIMD
// target; only kernels may include it.
#include <cstdint>

#include "core/engine/spiking/kernels/active_inputs.h"
#include "core/engine/spiking/kernels/simd/vectors-inl.h"
#include "hwy/highway.h"

// Highway's include guard, which admits this file once per target.
#if defined(CORE_ENGINE_SPIKING_KERNELS_SIMD_INTEGER_VECTORS_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef CORE_ENGINE_SPIKING_KERNELS_SIMD_INTEGER_VECTORS_INL_H_
#undef CORE_ENGINE_SPIKING_KERNELS_SIMD_INTEGER_VECTORS_INL_H_
#else
#define CORE_ENGINE_SPIKING_KERNELS_SIMD_INTEGER_VECTORS_INL_H_
#endif

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {

using I16 = hn::CappedTag<int16_t, 32>;
using I8 = hn::Rebind<int8_t, I16>;  // as many lanes as I16, in half a vector
using VecI16 = hn::Vec<I16>;
using VecI32 = hn::Vec<I32>;

constexpr int kVector16 = static_cast<int>(hn::MaxLanes(I16()));

// Loads one vector of 8-bit weights as 16-bit numbers.
HWY_INLINE VecI16 LoadWide(const int8_t* weights) {
  return hn::PromoteTo(I16(), hn::LoadU(I8(), weights));
}

// A sum of products of adjacent pairs of lanes. Which products are in which of its two parts, and
// in which lanes, depends on the target, so the parts serve for nothing but Total().
#if HWY_TARGET == HWY_EMU128

// The portable target has the order of NEON instead of Highway's, so that the tests on every
// processor find code that relies on the order of another target.
class PairSum {
 public:
  HWY_INLINE PairSum() : low_(hn::Zero(I32())), high_(hn::Zero(I32())) {}
  HWY_INLINE void Add(VecI16 a, VecI16 b) {
    const hn::Half<I16> half;
    low_ = hn::Add(low_, Product(hn::LowerHalf(half, a), hn::LowerHalf(half, b)));
    high_ = hn::Add(high_, Product(hn::UpperHalf(half, a), hn::UpperHalf(half, b)));
  }
  HWY_INLINE VecI32 Total() const {
    const I32 d;
    return hn::Add(hn::ConcatEven(d, high_, low_), hn::ConcatOdd(d, high_, low_));
  }

 private:
  template <class Half>
  static HWY_INLINE VecI32 Product(Half a, Half b) {
    const I32 d;
    return hn::Mul(hn::PromoteTo(d, a), hn::PromoteTo(d, b));
  }

  VecI32 low_;
  VecI32 high_;
};

#else

class PairSum {
 public:
  // Not by initialisers: an implicit constructor may not use the instructions of the target.
  HWY_INLINE PairSum() : first_(hn::Zero(I32())), second_(hn::Zero(I32())) {}
  HWY_INLINE void Add(VecI16 a, VecI16 b) {
    first_ = hn::ReorderWidenMulAccumulate(I32(), a, b, first_, second_);
  }
  HWY_INLINE VecI32 Total() const { return hn::RearrangeToOddPlusEven(first_, second_); }

 private:
  VecI32 first_;
  VecI32 second_;
};

#endif  // HWY_TARGET == HWY_EMU128

// Returns the sum of counts[0, size). REQUIRES: `size` is a multiple of kLanes.
HWY_INLINE uint64_t SumCounts(const int16_t* counts, int size) {
  const I16 d;
  PairSum sum;
  for (int j = 0; j < size; j += kVector16) {
    sum.Add(hn::LoadU(d, counts + j), hn::Set(d, int16_t{1}));
  }
  return static_cast<uint64_t>(hn::GetLane(hn::SumOfLanes(I32(), sum.Total())));
}

// Sets `pairs` to the pairs of inputs of a map of which at least one is not 0, ascending. Returns
// the number of nonzero products of all inputs. `inputs` is [pad(map.inputs)].
template <class Map>
HWY_INLINE uint64_t FindActive(const Map& map, const int16_t* inputs, ActiveInputs& pairs) {
  const I16 d;
  const I32 di;
  pairs.clear();
  const auto one = hn::Set(d, int16_t{1});
  PairSum products;
  for (int j = 0; j < map.inputs; j += kVector16) {
    const auto input = hn::LoadU(d, inputs + j);
    const auto pair_fires = hn::Ne(hn::BitCast(di, input), hn::Zero(di));
    uint32_t bits = MaskBits(di, pair_fires);
    if (bits == 0) continue;
    for (; bits != 0; bits &= bits - 1) pairs.push_back(j / 2 + __builtin_ctz(bits));
    const auto nonzero = hn::LoadU(d, map.nonzero.data() + j);
    const auto silent = hn::Eq(input, hn::Zero(d));
    products.Add(hn::IfThenZeroElse(silent, nonzero), one);
  }
  return static_cast<uint64_t>(hn::GetLane(hn::SumOfLanes(di, products.Total())));
}

}  // namespace spikeserve::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif  // toggle
