// The kernels of norm_kernel.h. Only integer_kernels.cc may include it, which compiles it once per
// SIMD target.
#include <algorithm>

#include "core/engine/spiking/kernels/norm_kernel.h"
#include "core/engine/spiking/kernels/simd/integer_vectors-inl.h"
#include "core/engine/spiking/kernels/simd/vectors-inl.h"
#include "core/math/fixed_point.h"
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {
namespace {

using HalfVector = hn::Rebind<int16_t, I32>;  // as many lanes as I32, in half a vector

// Loads one vector of 16-bit numbers as 32-bit ones.
HWY_INLINE VecI32 LoadWide16(const int16_t* numbers) {
  return hn::PromoteTo(I32(), hn::LoadU(HalfVector(), numbers));
}

// Returns the nearest number of the residual stream.
HWY_INLINE VecI32 Saturate(VecI32 value) {
  const I32 d;
  return hn::Clamp(value, hn::Set(d, -kLargestResidual), hn::Set(d, kLargestResidual));
}

// Adds x to `sums` and returns the mean.
HWY_INLINE int32_t AddAndFindMean(const PackedNorm& norm, const int16_t* x, int32_t* sums) {
  const I32 d;
  auto total = hn::Zero(d);
  for (int k = 0; k < norm.width; k += kVector) {
    const auto sum = Saturate(hn::Add(hn::LoadU(d, sums + k), LoadWide16(x + k)));
    hn::StoreU(sum, d, sums + k);
    total = hn::Add(total, sum);
  }
  return static_cast<int32_t>(RoundDivide(hn::GetLane(hn::SumOfLanes(d, total)), norm.size));
}

// Subtracts the mean from `sums` and returns the sum of the squares.
HWY_INLINE uint64_t CentreAndSquare(const PackedNorm& norm, int32_t mean, int32_t* sums) {
  const I32 d;
  const hn::Repartition<uint32_t, I32> magnitudes;
  const hn::RepartitionToWide<hn::Repartition<uint32_t, I32>> wide;
  auto even = hn::Zero(wide);
  auto odd = hn::Zero(wide);
  for (int k = 0; k < norm.width; k += kVector) {
    const auto centred = hn::Sub(hn::LoadU(d, sums + k), hn::Set(d, mean));
    hn::StoreU(centred, d, sums + k);
    // In WebAssembly, Highway's MulEven takes signed numbers for unsigned ones.
    const auto magnitude = hn::BitCast(magnitudes, hn::Abs(centred));
    const auto swapped = hn::Shuffle2301(magnitude);
    even = hn::Add(even, hn::MulEven(magnitude, magnitude));
    odd = hn::Add(odd, hn::MulEven(swapped, swapped));
  }
  const uint64_t squares = hn::GetLane(hn::SumOfLanes(wide, hn::Add(even, odd)));
  const int64_t padding = norm.width - norm.size;  // lanes that were 0 before the subtraction
  return squares - static_cast<uint64_t>(padding * mean * mean);
}

void NormalizeImpl(const PackedNorm& norm, int32_t* sums, int16_t* x) {
  const I32 d;
  const int32_t mean = AddAndFindMean(norm, x, sums);
  const InverseRoot root = InverseRootOf(CentreAndSquare(norm, mean, sums));
  const int left = std::max(-root.shift, 0);
  const int right = std::max(root.shift, 0);
  const auto rounding = hn::Set(d, right > 0 ? 1 << (right - 1) : 0);
  const auto norm_rounding = hn::Set(d, norm.shift > 0 ? 1 << (norm.shift - 1) : 0);
  const auto inverse = hn::Set(d, root.inverse);
  const auto half = hn::Set(d, 1 << 14);
  // Everything fits 32 bits: see fixed_point.h and docs/design/integer.md.
  for (int k = 0; k < norm.width; k += kVector) {
    const auto shifted = hn::ShiftLeftSame(hn::LoadU(d, sums + k), left);
    const auto scaled = hn::ShiftRightSame(hn::Add(shifted, rounding), right);
    const auto unit = hn::ShiftRight<15>(hn::Add(hn::Mul(scaled, inverse), half));
    const auto product = hn::Mul(unit, LoadWide16(norm.weight.data() + k));
    const auto weighted = hn::ShiftRightSame(hn::Add(product, norm_rounding), norm.shift);
    const auto value = Saturate(hn::Add(weighted, LoadWide16(norm.bias.data() + k)));
    hn::StoreU(hn::DemoteTo(HalfVector(), value), HalfVector(), x + k);
  }
}

void AddLimitedImpl(int width, const int32_t* sums, int16_t* x) {
  const I32 d;
  for (int k = 0; k < width; k += kVector) {
    const auto value = Saturate(hn::Add(hn::LoadU(d, sums + k), LoadWide16(x + k)));
    hn::StoreU(hn::DemoteTo(HalfVector(), value), HalfVector(), x + k);
  }
}

}  // namespace
}  // namespace spikeserve::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace spikeserve::kernels {

HWY_EXPORT(NormalizeImpl);
HWY_EXPORT(AddLimitedImpl);

void Normalize(const PackedNorm& norm, int32_t* sums, int16_t* x) {
  HWY_DYNAMIC_DISPATCH(NormalizeImpl)(norm, sums, x);
}

void AddLimited(int width, const int32_t* sums, int16_t* x) {
  HWY_DYNAMIC_DISPATCH(AddLimitedImpl)(width, sums, x);
}

}  // namespace spikeserve::kernels
#endif  // HWY_ONCE
