// The exponential of a vector. Compiled once per SIMD target; only kernels may include it.
#include "core/engine/spiking/kernels/simd/vectors-inl.h"
#include "hwy/highway.h"

// Highway's include guard, which admits this file once per target.
#if defined(CORE_ENGINE_SPIKING_KERNELS_SIMD_EXP_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef CORE_ENGINE_SPIKING_KERNELS_SIMD_EXP_INL_H_
#undef CORE_ENGINE_SPIKING_KERNELS_SIMD_EXP_INL_H_
#else
#define CORE_ENGINE_SPIKING_KERNELS_SIMD_EXP_INL_H_
#endif

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {
namespace {

// Equals spikeserve::Exp bit for bit in every lane.
HWY_INLINE VecF Exp(VecF x) {
  const F32 d;
  const I32 di;
  const auto round = hn::Set(d, 12582912.0f);
  // Not by Min and Max, which return NaN on some targets and the bound on others.
  x = hn::IfThenElse(hn::Lt(x, hn::Set(d, -87.0f)), hn::Set(d, -87.0f), x);
  x = hn::IfThenElse(hn::Gt(x, hn::Set(d, 88.0f)), hn::Set(d, 88.0f), x);
  const auto n = hn::Sub(hn::Add(hn::Mul(x, hn::Set(d, 1.44269504088896341f)), round), round);
  x = hn::Sub(x, hn::Mul(n, hn::Set(d, 0.693359375f)));
  x = hn::Sub(x, hn::Mul(n, hn::Set(d, -2.12194440e-4f)));
  auto y = hn::Set(d, 1.9875691500e-4f);
  for (const float coefficient :
       {1.3981999507e-3f, 8.3334519073e-3f, 4.1665795894e-2f, 1.6666665459e-1f, 5.0000001201e-1f}) {
    y = hn::Add(hn::Mul(y, x), hn::Set(d, coefficient));
  }
  y = hn::Add(hn::Add(hn::Mul(y, hn::Mul(x, x)), x), hn::Set(d, 1.0f));
  const auto exponent = hn::ShiftLeft<23>(hn::Add(hn::ConvertTo(di, n), hn::Set(di, 127)));
  return hn::Mul(y, hn::BitCast(d, exponent));
}

}  // namespace
}  // namespace spikeserve::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif  // toggle
