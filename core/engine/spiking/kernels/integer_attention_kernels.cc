#include "core/engine/spiking/kernels/integer_attention_kernels.h"

#include <algorithm>
#include <cstdlib>

#include "core/math/fixed_point.h"
#include "core/model/fixed_point_weights.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/engine/spiking/kernels/integer_attention_kernels.cc"
// clang-format off
#include "hwy/foreach_target.h"  // must come first: compiles the rest of this file once per target
// clang-format on
#include "core/engine/spiking/kernels/integer_simd-inl.h"
#include "core/engine/spiking/kernels/simd-inl.h"
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {
namespace {

uint64_t OverlapsImpl(const uint64_t* query, int words, const uint64_t* keys, size_t stride,
                      const std::vector<int>& slots, int32_t* overlaps) {
  uint64_t sum = 0;
  for (size_t i = 0; i < slots.size(); ++i) {
    const uint64_t* const key = keys + static_cast<size_t>(slots[i]) * stride;
    int bits = 0;
    for (int word = 0; word < words; ++word) bits += __builtin_popcountll(query[word] & key[word]);
    overlaps[i] = bits;
    sum += static_cast<uint64_t>(bits);
  }
  return sum;
}

// Returns the largest overlap if `largest`, and the smallest one otherwise.
HWY_INLINE int32_t Best(bool largest, int tokens, const int32_t* overlaps) {
  const I32 d;
  auto best = hn::LoadU(d, overlaps);
  for (int i = 0; i < tokens; i += kVector) {
    const auto next = hn::LoadU(d, overlaps + i);
    best = largest ? hn::Max(best, next) : hn::Min(best, next);
  }
  return hn::GetLane(largest ? hn::MaxOfLanes(d, best) : hn::MinOfLanes(d, best));
}

int32_t ShiftmaxImpl(int32_t scale, int tokens, int32_t* overlaps) {
  const I32 d;
  std::fill(overlaps + tokens, overlaps + PadToLanes(tokens), overlaps[0]);
  const auto best = hn::Set(d, Best(scale >= 0, tokens, overlaps));
  const auto factor = hn::Set(d, std::abs(scale));
  const auto rounding = hn::Set(d, 1 << (kScaleFraction - 1));
  // Farther overlaps have weight 0, too, unless the scale is 0; the product has 31 bits.
  const auto farthest = hn::Set(d, 65535);
  for (int i = 0; i < tokens; i += kVector) {
    const auto distance = hn::Min(hn::Abs(hn::Sub(hn::LoadU(d, overlaps + i), best)), farthest);
    const auto octaves =
        hn::ShiftRight<kScaleFraction>(hn::Add(hn::Mul(distance, factor), rounding));
    const auto weight = hn::Shr(hn::Set(d, 256), hn::Min(octaves, hn::Set(d, 9)));
    hn::StoreU(weight, d, overlaps + i);
  }
  std::fill(overlaps + tokens, overlaps + PadToLanes(tokens), 0);
  auto sum = hn::Zero(d);
  for (int i = 0; i < tokens; i += kVector) sum = hn::Add(sum, hn::LoadU(d, overlaps + i));
  return hn::GetLane(hn::SumOfLanes(d, sum));
}

void WeighValuesImpl(const std::vector<WeightedValues>& tokens, int size, int32_t* sums) {
  const I32 d;
  const hn::Rebind<int16_t, I32> narrow;  // as many lanes as I32, in half a vector
  ForEachBlock<4>(0, PadToLanes(size), [&](int lane, auto vectors) HWY_ATTR {
    VecI32 total[vectors];
    for (int v = 0; v < vectors; ++v) total[v] = hn::Zero(d);
    for (const WeightedValues& token : tokens) {
      const auto weight = hn::Set(d, token.weight);
      const int16_t* values = Opaque(token.values + lane);
      for (int v = 0; v < vectors; ++v) {
        const auto wide = hn::PromoteTo(d, hn::LoadU(narrow, values + v * kVector));
        total[v] = hn::Add(total[v], hn::Mul(weight, wide));
      }
    }
    for (int v = 0; v < vectors; ++v) hn::StoreU(total[v], d, sums + lane + v * kVector);
  });
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

HWY_EXPORT(OverlapsImpl);
HWY_EXPORT(ShiftmaxImpl);
HWY_EXPORT(WeighValuesImpl);
HWY_EXPORT(ScaleSumsImpl);

uint64_t Overlaps(const uint64_t* query, int words, const uint64_t* keys, size_t stride,
                  const std::vector<int>& slots, int32_t* overlaps) {
  return HWY_DYNAMIC_DISPATCH(OverlapsImpl)(query, words, keys, stride, slots, overlaps);
}

int32_t Shiftmax(int32_t scale, int tokens, int32_t* overlaps) {
  return HWY_DYNAMIC_DISPATCH(ShiftmaxImpl)(scale, tokens, overlaps);
}

void WeighValues(const std::vector<WeightedValues>& tokens, int size, int32_t* sums) {
  HWY_DYNAMIC_DISPATCH(WeighValuesImpl)(tokens, size, sums);
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
