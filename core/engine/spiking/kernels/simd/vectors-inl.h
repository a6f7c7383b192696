// Defines types and small helpers for the kernels. Compiled once per SIMD target; only kernels may
// include it.
#include <algorithm>
#include <cstdint>
#include <cstring>
#include <type_traits>

#include "core/engine/spiking/packed/packed_linear.h"
#include "hwy/highway.h"

// Highway's include guard, which admits this file once per target.
#if defined(CORE_ENGINE_SPIKING_KERNELS_SIMD_VECTORS_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef CORE_ENGINE_SPIKING_KERNELS_SIMD_VECTORS_INL_H_
#undef CORE_ENGINE_SPIKING_KERNELS_SIMD_VECTORS_INL_H_
#else
#define CORE_ENGINE_SPIKING_KERNELS_SIMD_VECTORS_INL_H_
#endif

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {

namespace hn = hwy::HWY_NAMESPACE;

using F32 = hn::CappedTag<float, 16>;
using I32 = hn::RebindToSigned<F32>;
using U32 = hn::RebindToUnsigned<F32>;
using VecF = hn::Vec<F32>;

constexpr int kVector = static_cast<int>(hn::MaxLanes(F32()));
constexpr int kVectorsPerWord = kLanes / kVector;

// Whether the target has 32 vector registers, as AVX-512 and arm64 have, instead of 16. The
// portable target is compiled as if it had them: its vectors are as long as those of arm64, so that
// tests on any processor run the blocks of arm64.
constexpr bool kManyRegisters =
    HWY_TARGET <= HWY_AVX3 || HWY_ARCH_ARM_A64 || HWY_TARGET == HWY_EMU128;

// Returns `mask` as bits, one per lane.
template <class D, class Mask>
HWY_INLINE uint32_t MaskBits(D d, Mask mask) {
  uint8_t bytes[8] = {};
  hn::StoreMaskBits(d, mask, bytes);
  uint16_t bits;  // at most 16 lanes; every target here is little-endian
  std::memcpy(&bits, bytes, sizeof(bits));
  return bits;
}

// Returns the mask that has the lanes set in `bits`.
template <class D>
HWY_INLINE auto MaskFromBits(D d, uint32_t bits) {
  const uint8_t bytes[8] = {static_cast<uint8_t>(bits), static_cast<uint8_t>(bits >> 8)};
  return hn::LoadMaskBits(d, bytes);
}

// Returns `address`, but hides its origin from the compiler. Otherwise GCC moves the offset of each
// vector of a row out of the loop over rows, and has no registers left for the sums.
template <class T>
HWY_INLINE const T* Opaque(const T* address) {
  asm("" : "+r"(address));
  return address;
}

// Stores the mask of vector number `v` of a row. `bytes` is the start of the row's bits. Calls for
// one row must be in ascending order of v.
template <class D, class Mask>
HWY_INLINE void StoreMask(D d, Mask mask, uint8_t* bytes, int v) {
  constexpr int kMaskLanes = static_cast<int>(hn::MaxLanes(D()));
  if constexpr (kMaskLanes >= 8) {
    hn::StoreMaskBits(d, mask, bytes + v * kMaskLanes / 8);
  } else {
    constexpr int kPerByte = 8 / kMaskLanes;
    const int shift = v % kPerByte * kMaskLanes;
    uint8_t& byte = bytes[v / kPerByte];
    byte = static_cast<uint8_t>((shift == 0 ? 0 : byte) | MaskBits(d, mask) << shift);
  }
}

// Calls block(lane, count<V>) for the lanes [lane, width), both multiples of kLanes, in blocks of V
// vectors of kVectorLanes lanes. V is kVectors first, so that the chains of additions overlap, and
// then halves down to kLanes lanes. It is always rounded down to a multiple of kLanes lanes, so
// that no block leaves less than that behind it.
template <int kVectors, int kVectorLanes = kVector, class Block>
HWY_INLINE void ForEachBlock(int lane, int width, Block block) {
  constexpr int kSmallest = kLanes / kVectorLanes;
  constexpr int kBlock = std::max(kSmallest, kVectors / kSmallest * kSmallest);
  for (; lane + kBlock * kVectorLanes <= width; lane += kBlock * kVectorLanes) {
    block(lane, std::integral_constant<int, kBlock>());
  }
  if constexpr (kBlock > kSmallest) ForEachBlock<kBlock / 2, kVectorLanes>(lane, width, block);
}

}  // namespace spikeserve::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif  // toggle
