#include "core/engine/kernels/lif_kernels.h"

#include <algorithm>

#define HWY_WANT_AVX3_DL 1
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/engine/kernels/lif_kernels.cc"
// clang-format off
#include "hwy/foreach_target.h"  // must come first: compiles what follows once per target
// clang-format on
#include "core/engine/kernels/simd-inl.h"
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {
namespace {

// The period is one more than the number of thresholds the current fails to reach.
HWY_INLINE hn::Vec<I32> Periods(VecF current, const std::vector<float>& thresholds) {
  const F32 d;
  const I32 di;
  auto period = hn::Set(di, 1);
  for (const float threshold : thresholds) {
    const auto below = hn::RebindMask(di, hn::Lt(current, hn::Set(d, threshold)));
    period = hn::Sub(period, hn::VecFromMask(di, below));  // a true lane is -1
  }
  const auto silent = hn::Gt(period, hn::Set(di, static_cast<int32_t>(thresholds.size())));
  return hn::IfThenZeroElse(silent, period);
}

void CoderPeriodsImpl(const PeriodTable& table, const float* x, const float* gain,
                      const float* bias, int size, int32_t* periods, uint32_t* active) {
  const F32 d;
  const I32 di;
  std::fill_n(active, (size + 31) / 32, 0u);
  int j = 0;
  for (; j + kVector <= size; j += kVector) {
    const auto current =
        hn::Add(hn::Mul(hn::LoadU(d, x + j), hn::LoadU(d, gain + j)), hn::LoadU(d, bias + j));
    const auto period = Periods(current, table.thresholds());
    hn::StoreU(period, di, periods + j);
    active[j / 32] |= MaskBits(di, hn::Gt(period, hn::Zero(di))) << (j % 32);
  }
  for (; j < size; ++j) {
    periods[j] = table.Period(x[j] * gain[j] + bias[j]);
    active[j / 32] |= static_cast<uint32_t>(periods[j] > 0) << (j % 32);
  }
}

void SumRowsImpl(const PackedLinear& linear, const int32_t* members, int count, int width,
                 float* sum) {
  const F32 d;
  ForEachBlock(width, [&](int lane, auto vectors) HWY_ATTR {
    VecF total[vectors];
    for (int v = 0; v < vectors; ++v) total[v] = hn::Zero(d);
    for (int m = 0; m < count; ++m) {
      const float* row = linear.row(members[m]) + lane;
      for (int v = 0; v < vectors; ++v) {
        total[v] = hn::Add(total[v], hn::LoadU(d, row + v * kVector));
      }
    }
    for (int v = 0; v < vectors; ++v) hn::StoreU(total[v], d, sum + lane + v * kVector);
  });
}

// Runs kVectors vectors of neurons from `lane` on; calls on_spike(tick, v, mask) for each of them.
template <int kVectors, class OnSpike>
HWY_INLINE void RunLif(const Lif& lif, const float* bias, const Drive& drive, int lane,
                       OnSpike on_spike) {
  const F32 d;
  const auto decay = hn::Set(d, lif.decay);
  const auto threshold = hn::Set(d, lif.threshold);
  VecF membrane[kVectors];
  VecF constant[kVectors];
  for (int v = 0; v < kVectors; ++v) {
    membrane[v] = hn::Zero(d);
    constant[v] = hn::LoadU(d, bias + lane + v * kVector);
  }
  for (int tick = 0; tick < drive.ticks; ++tick) {
    VecF current[kVectors];
    for (int v = 0; v < kVectors; ++v) current[v] = constant[v];
    for (int k = drive.offsets[tick]; k < drive.offsets[tick + 1]; ++k) {
      const float* term = drive.terms[k] + lane;
      for (int v = 0; v < kVectors; ++v) {
        current[v] = hn::Add(current[v], hn::LoadU(d, term + v * kVector));
      }
    }
    for (int v = 0; v < kVectors; ++v) {
      membrane[v] = hn::Add(hn::Mul(decay, membrane[v]), current[v]);
      const auto spike = hn::Ge(membrane[v], threshold);
      membrane[v] = hn::IfThenZeroElse(spike, membrane[v]);
      on_spike(tick, v, spike);
    }
  }
}

void LifBitsImpl(const Lif& lif, const float* bias, const Drive& drive, int width, uint32_t* bits) {
  const F32 d;
  const int words = width / kLanes;
  ForEachBlock(width, [&](int lane, auto vectors) HWY_ATTR {
    constexpr int kWords = vectors / kVectorsPerWord;
    uint32_t word[kWords];
    RunLif<vectors>(lif, bias, drive, lane, [&](int tick, int v, auto spike) HWY_ATTR {
      const uint32_t part = MaskBits(d, spike) << (v % kVectorsPerWord * kVector);
      uint32_t& current = word[v / kVectorsPerWord];
      current = v % kVectorsPerWord == 0 ? part : current | part;
      if (v + 1 == vectors) std::copy_n(word, kWords, bits + tick * words + lane / kLanes);
    });
  });
}

uint64_t LifRatesImpl(const Lif& lif, const float* bias, const Drive& drive, int width,
                      float* rates) {
  const F32 d;
  const I32 di;
  const auto ticks = hn::Set(d, static_cast<float>(drive.ticks));
  auto total = hn::Zero(di);
  ForEachBlock(width, [&](int lane, auto vectors) HWY_ATTR {
    hn::Vec<I32> count[vectors];
    for (int v = 0; v < vectors; ++v) count[v] = hn::Zero(di);
    RunLif<vectors>(lif, bias, drive, lane, [&](int, int v, auto spike) HWY_ATTR {
      count[v] = hn::Sub(count[v], hn::VecFromMask(di, hn::RebindMask(di, spike)));
    });
    for (int v = 0; v < vectors; ++v) {
      total = hn::Add(total, count[v]);
      hn::StoreU(hn::Div(hn::ConvertTo(d, count[v]), ticks), d, rates + lane + v * kVector);
    }
  });
  return static_cast<uint64_t>(hn::GetLane(hn::SumOfLanes(di, total)));
}

uint64_t CountBitsImpl(const uint32_t* words, int count) {
  const U32 du;
  auto total = hn::Zero(du);
  int i = 0;
  for (; i + kVector <= count; i += kVector) {
    total = hn::Add(total, hn::PopulationCount(hn::LoadU(du, words + i)));
  }
  uint64_t bits = hn::GetLane(hn::SumOfLanes(du, total));
  for (; i < count; ++i) bits += __builtin_popcount(words[i]);  // the target's own instruction
  return bits;
}

}  // namespace
}  // namespace spikeserve::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace spikeserve::kernels {

HWY_EXPORT(CoderPeriodsImpl);
HWY_EXPORT(SumRowsImpl);
HWY_EXPORT(LifBitsImpl);
HWY_EXPORT(LifRatesImpl);
HWY_EXPORT(CountBitsImpl);

void CoderPeriods(const PeriodTable& table, const float* x, const float* gain, const float* bias,
                  int size, int32_t* periods, uint32_t* active) {
  HWY_DYNAMIC_DISPATCH(CoderPeriodsImpl)(table, x, gain, bias, size, periods, active);
}

void SumRows(const PackedLinear& linear, const int32_t* members, int count, int width, float* sum) {
  HWY_DYNAMIC_DISPATCH(SumRowsImpl)(linear, members, count, width, sum);
}

void LifBits(const Lif& lif, const float* bias, const Drive& drive, int width, uint32_t* bits) {
  HWY_DYNAMIC_DISPATCH(LifBitsImpl)(lif, bias, drive, width, bits);
}

uint64_t LifRates(const Lif& lif, const float* bias, const Drive& drive, int width, float* rates) {
  return HWY_DYNAMIC_DISPATCH(LifRatesImpl)(lif, bias, drive, width, rates);
}

uint64_t CountBits(const uint32_t* words, int count) {
  return HWY_DYNAMIC_DISPATCH(CountBitsImpl)(words, count);
}

}  // namespace spikeserve::kernels
#endif  // HWY_ONCE
