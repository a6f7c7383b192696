// Sums whose order does not depend on the length of a vector. Compiled once per SIMD target; only
// kernels may include it.
#include "core/engine/spiking/kernels/simd/vectors-inl.h"
#include "core/math/layer_norm.h"
#include "hwy/highway.h"

// Highway's include guard, which admits this file once per target.
#if defined(CORE_ENGINE_SPIKING_KERNELS_SIMD_ORDERED_SUM_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef CORE_ENGINE_SPIKING_KERNELS_SIMD_ORDERED_SUM_INL_H_
#undef CORE_ENGINE_SPIKING_KERNELS_SIMD_ORDERED_SUM_INL_H_
#else
#define CORE_ENGINE_SPIKING_KERNELS_SIMD_ORDERED_SUM_INL_H_
#endif

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {
namespace {

// Returns the sum of term(i) over kSumLanes interleaved partial sums, folded as in
// core/math/layer_norm.h.
template <class Term>
HWY_INLINE float OrderedSum(int size, Term term) {
  const F32 d;
  constexpr int kParts = kSumLanes / kVector;
  VecF part[kParts];
  for (int p = 0; p < kParts; ++p) part[p] = hn::Zero(d);
  for (int i = 0; i < size; i += kSumLanes) {
    for (int p = 0; p < kParts; ++p) part[p] = hn::Add(part[p], term(i + p * kVector));
  }
  float partial[kSumLanes];
  for (int p = 0; p < kParts; ++p) hn::StoreU(part[p], d, partial + p * kVector);
  for (int half = kSumLanes / 2; half > 0; half /= 2) {
    for (int lane = 0; lane < half; ++lane) partial[lane] += partial[lane + half];
  }
  return partial[0];
}

}  // namespace
}  // namespace spikeserve::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif  // toggle
