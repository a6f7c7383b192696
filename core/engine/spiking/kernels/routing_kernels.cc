#include "core/engine/spiking/kernels/routing_kernels.h"

#include <algorithm>

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/engine/spiking/kernels/routing_kernels.cc"
// clang-format off
#include "hwy/foreach_target.h"  // must come first: compiles the rest of this file once per target
// clang-format on
#include "core/engine/spiking/kernels/simd/exp-inl.h"
#include "core/engine/spiking/kernels/simd/vectors-inl.h"
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {
namespace {

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

HWY_EXPORT(SoftmaxImpl);
HWY_EXPORT(GateHeadsImpl);

void Softmax(float* rows, int count, int stride, int size) {
  HWY_DYNAMIC_DISPATCH(SoftmaxImpl)(rows, count, stride, size);
}

void GateHeads(const HeadOutputs& heads, const float* gates, int stride, bool concat,
               float* merged) {
  HWY_DYNAMIC_DISPATCH(GateHeadsImpl)(heads, gates, stride, concat, merged);
}

}  // namespace spikeserve::kernels
#endif  // HWY_ONCE
