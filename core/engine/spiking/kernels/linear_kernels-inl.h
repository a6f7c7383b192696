// The kernels of linear_kernels.h. Only float_kernels.cc may include it, which compiles it once per
// SIMD target.
#include <algorithm>
#include <cmath>
#include <vector>

#include "core/engine/spiking/kernels/linear_kernels.h"
#include "core/engine/spiking/kernels/simd/exp-inl.h"
#include "core/engine/spiking/kernels/simd/ordered_sum-inl.h"
#include "core/engine/spiking/kernels/simd/vectors-inl.h"
#include "core/math/layer_norm.h"
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {
namespace {

// Appends `first` + i to `lanes` for every bit i set in `bits`.
HWY_INLINE void AppendLanes(uint32_t bits, int first, std::vector<int32_t>& lanes) {
  for (; bits != 0; bits &= bits - 1) lanes.push_back(first + __builtin_ctz(bits));
}

// Sets `active` to the inputs that are nonzero in one of `ticks` rows [stride] or more, ascending.
// Returns the number of their nonzero products.
HWY_INLINE uint64_t FindActive(const PackedLinear& linear, const float* input, int stride,
                               int ticks, ActiveInputs& active) {
  const F32 d;
  const U32 du;
  active.clear();
  auto products = hn::Zero(du);
  int j = 0;
  for (; j + kVector <= linear.inputs; j += kVector) {
    const auto nonzero = hn::LoadU(du, linear.nonzero.data() + j);
    auto any = hn::Zero(du);
    for (int t = 0; t < ticks; ++t) {
      const auto row = hn::LoadU(d, input + static_cast<size_t>(t) * stride + j);
      // Not by Ne, which is false for NaN on some targets.
      const auto mask = hn::RebindMask(du, hn::Not(hn::Eq(row, hn::Zero(d))));
      products = hn::Add(products, hn::IfThenElseZero(mask, nonzero));
      any = hn::Or(any, hn::VecFromMask(du, mask));
    }
    AppendLanes(MaskBits(du, hn::Ne(any, hn::Zero(du))), j, active);
  }
  uint64_t total = hn::GetLane(hn::SumOfLanes(du, products));
  for (; j < linear.inputs; ++j) {
    bool any = false;
    for (int t = 0; t < ticks; ++t) {
      if (input[static_cast<size_t>(t) * stride + j] == 0.0f) continue;
      total += linear.nonzero[j];
      any = true;
    }
    if (any) active.push_back(j);
  }
  return total;
}

uint64_t AffineImpl(const PackedLinear& linear, const float* input, ActiveInputs* active,
                    float* output) {
  const F32 d;
  const uint64_t products = FindActive(linear, input, /*stride=*/0, /*ticks=*/1, *active);
  ForEachBlock<8>(0, linear.width, [&](int lane, auto vectors) HWY_ATTR {
    VecF total[vectors];
    for (int v = 0; v < vectors; ++v) {
      total[v] = hn::LoadU(d, linear.bias.data() + lane + v * kVector);
    }
    for (const int32_t j : *active) {
      const auto x = hn::Set(d, input[j]);
      const float* row = Opaque(linear.row(j) + lane);
      for (int v = 0; v < vectors; ++v) {
        total[v] = hn::Add(total[v], hn::Mul(hn::LoadU(d, row + v * kVector), x));
      }
    }
    for (int v = 0; v < vectors; ++v) hn::StoreU(total[v], d, output + lane + v * kVector);
  });
  return products;
}

// Computes kTicks rows at once, so that a weight is loaded once for all of them.
template <int kTicks>
HWY_INLINE void AffineBlock(const PackedLinear& linear, const ActiveInputs& active,
                            const float* input, int stride, float* output) {
  const F32 d;
  for (int lane = 0; lane < linear.outputs; lane += kVector) {
    VecF total[kTicks];
    for (int t = 0; t < kTicks; ++t) total[t] = hn::LoadU(d, linear.bias.data() + lane);
    for (const int32_t j : active) {
      const auto weight = hn::LoadU(d, linear.row(j) + lane);
      for (int t = 0; t < kTicks; ++t) {
        const float x = input[static_cast<size_t>(t) * stride + j];
        total[t] = hn::Add(total[t], hn::Mul(weight, hn::Set(d, x)));
      }
    }
    for (int t = 0; t < kTicks; ++t) {
      hn::StoreU(total[t], d, output + static_cast<size_t>(t) * linear.width + lane);
    }
  }
}

uint64_t AffineTicksImpl(const PackedLinear& linear, const float* input, int stride, int ticks,
                         ActiveInputs* active, float* output) {
  const uint64_t products = FindActive(linear, input, stride, ticks, *active);
  int t = 0;
  const auto in = [&] { return input + static_cast<size_t>(t) * stride; };
  const auto out = [&] { return output + static_cast<size_t>(t) * linear.width; };
  for (; t + 5 <= ticks; t += 5) AffineBlock<5>(linear, *active, in(), stride, out());
  for (; t + 2 <= ticks; t += 2) AffineBlock<2>(linear, *active, in(), stride, out());
  for (; t < ticks; ++t) AffineBlock<1>(linear, *active, in(), stride, out());
  return products;
}

void LayerNormImpl(const float* weight, const float* bias, float* x, int size) {
  if (size % kSumLanes != 0) return spikeserve::LayerNorm(weight, bias, x, size);
  const F32 d;
  const float mean = OrderedSum(size, [&](int i) HWY_ATTR { return hn::LoadU(d, x + i); }) /
                     static_cast<float>(size);
  const float sum = OrderedSum(size, [&](int i) HWY_ATTR {
    const auto centred = hn::Sub(hn::LoadU(d, x + i), hn::Set(d, mean));
    hn::StoreU(centred, d, x + i);
    return hn::Mul(centred, centred);
  });
  const float inverse = 1.0f / std::sqrt(sum / static_cast<float>(size) + kLayerNormEpsilon);
  for (int i = 0; i < size; i += kVector) {
    const auto scaled =
        hn::Mul(hn::Mul(hn::LoadU(d, x + i), hn::Set(d, inverse)), hn::LoadU(d, weight + i));
    hn::StoreU(hn::Add(scaled, hn::LoadU(d, bias + i)), d, x + i);
  }
}

void SoftmaxImpl(float* rows, int count, int stride, int size) {
  const F32 d;
  for (int r = 0; r < count; ++r) {
    float* row = rows + static_cast<size_t>(r) * stride;
    const float best = *std::max_element(row, row + size);
    for (int i = 0; i < size; i += kVector) {
      hn::StoreU(Exp(hn::Sub(hn::LoadU(d, row + i), hn::Set(d, best))), d, row + i);
    }
    float sum = 0.0f;
    for (int i = 0; i < size; ++i) sum += row[i];
    for (int i = 0; i < size; ++i) row[i] /= sum;
  }
}

void GateHeadsImpl(const HeadOutputs& heads, const float* gates, int stride, bool concat,
                   float* merged) {
  const F32 d;
  const int size = heads.head_size;
  const auto all_ticks = static_cast<float>(heads.all_ticks);
  const auto gate = [&](int t, int h) { return gates[static_cast<size_t>(t) * stride + h]; };
  for (int group = 0; group < (concat ? heads.heads : 1); ++group) {
    const int first = concat ? group : 0;
    const int last = concat ? group : heads.heads - 1;
    int k = 0;
    for (; k + kVector <= size; k += kVector) {
      auto total = hn::Zero(d);
      for (int t = 0; t < heads.ticks; ++t) {
        auto routed = hn::Zero(d);
        for (int h = first; h <= last; ++h) {
          routed =
              hn::Add(routed, hn::Mul(hn::Set(d, gate(t, h)), hn::LoadU(d, heads.at(t, h) + k)));
        }
        total = hn::Add(total, routed);
      }
      hn::StoreU(hn::Div(total, hn::Set(d, all_ticks)), d, merged + group * size + k);
    }
    for (; k < size; ++k) {
      float total = 0.0f;
      for (int t = 0; t < heads.ticks; ++t) {
        float routed = 0.0f;
        for (int h = first; h <= last; ++h) routed += gate(t, h) * heads.at(t, h)[k];
        total += routed;
      }
      merged[group * size + k] = total / all_ticks;
    }
  }
}

}  // namespace
}  // namespace spikeserve::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace spikeserve::kernels {

HWY_EXPORT(AffineImpl);
HWY_EXPORT(AffineTicksImpl);
HWY_EXPORT(LayerNormImpl);
HWY_EXPORT(SoftmaxImpl);
HWY_EXPORT(GateHeadsImpl);

uint64_t Affine(const PackedLinear& linear, const float* input, ActiveInputs* active,
                float* output) {
  return HWY_DYNAMIC_DISPATCH(AffineImpl)(linear, input, active, output);
}

uint64_t AffineTicks(const PackedLinear& linear, const float* input, int stride, int ticks,
                     ActiveInputs* active, float* output) {
  return HWY_DYNAMIC_DISPATCH(AffineTicksImpl)(linear, input, stride, ticks, active, output);
}

void LayerNorm(const float* weight, const float* bias, float* x, int size) {
  HWY_DYNAMIC_DISPATCH(LayerNormImpl)(weight, bias, x, size);
}

void Softmax(float* rows, int count, int stride, int size) {
  HWY_DYNAMIC_DISPATCH(SoftmaxImpl)(rows, count, stride, size);
}

void GateHeads(const HeadOutputs& heads, const float* gates, int stride, bool concat,
               float* merged) {
  HWY_DYNAMIC_DISPATCH(GateHeadsImpl)(heads, gates, stride, concat, merged);
}

}  // namespace spikeserve::kernels
#endif  // HWY_ONCE
