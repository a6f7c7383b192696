// The kernels of lif_kernels.h. Only float_kernels.cc may include it, which compiles it once per
// SIMD target.
#include <algorithm>

#include "core/engine/spiking/kernels/lif_kernels.h"
#include "core/engine/spiking/kernels/simd/vectors-inl.h"
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {
namespace {

// Number of vectors of neurons that run together: enough for their dependency chains to overlap,
// and few enough for membranes and currents to stay in the target's registers.
constexpr int kLifVectors = std::max(kVectorsPerWord, kManyRegisters ? 8 : 4);

// Number of vectors of a row that are added in one pass over the rows. The processor prefetches
// long contiguous reads better.
constexpr int kSumVectors = std::max(kVectorsPerWord, kManyRegisters ? 16 : 8);

// Returns the periods: one more than the number of thresholds less those that the current reaches,
// or 0 if it reaches none, as a NaN does.
HWY_INLINE hn::Vec<I32> Periods(VecF current, const std::vector<float>& thresholds) {
  const F32 d;
  const I32 di;
  const auto ticks = hn::Set(di, static_cast<int32_t>(thresholds.size()));
  auto period = hn::Add(ticks, hn::Set(di, 1));
  for (const float threshold : thresholds) {
    const auto reached = hn::RebindMask(di, hn::Ge(current, hn::Set(d, threshold)));
    period = hn::Add(period, hn::VecFromMask(di, reached));  // a true lane is -1
  }
  return hn::IfThenZeroElse(hn::Gt(period, ticks), period);
}

void CoderPeriodsImpl(const PeriodTable& table, const float* x, const float* gain,
                      const float* bias, int size, int32_t* periods, uint32_t* active) {
  const F32 d;
  const I32 di;
  std::fill_n(active, (size + 31) / 32, 0u);
  const auto smallest = hn::Set(d, table.thresholds().back());
  int j = 0;
  for (; j + kVector <= size; j += kVector) {
    const auto current =
        hn::Add(hn::Mul(hn::LoadU(d, x + j), hn::LoadU(d, gain + j)), hn::LoadU(d, bias + j));
    const uint32_t fires = MaskBits(d, hn::Ge(current, smallest));
    if (fires == 0) {
      hn::StoreU(hn::Zero(di), di, periods + j);
      continue;
    }
    active[j / 32] |= fires << (j % 32);
    hn::StoreU(Periods(current, table.thresholds()), di, periods + j);
  }
  for (; j < size; ++j) {
    periods[j] = table.Period(x[j] * gain[j] + bias[j]);
    active[j / 32] |= static_cast<uint32_t>(periods[j] > 0) << (j % 32);
  }
}

// Adds kVectors vectors of each row, from `lane` on.
template <int kVectors>
HWY_INLINE void SumBlock(const PackedLinear& linear, const int32_t* members, int count, int lane,
                         float* sum) {
  const F32 d;
  VecF total[kVectors];
  const float* first = linear.row(members[0]) + lane;
  for (int v = 0; v < kVectors; ++v) total[v] = hn::LoadU(d, first + v * kVector);
  for (int m = 1; m < count; ++m) {
    const float* row = Opaque(linear.row(members[m]) + lane);
    for (int v = 0; v < kVectors; ++v) {
      total[v] = hn::Add(total[v], hn::LoadU(d, row + v * kVector));
    }
  }
  for (int v = 0; v < kVectors; ++v) hn::StoreU(total[v], d, sum + lane + v * kVector);
}

void SumRowsImpl(const PackedLinear& linear, const int32_t* members, int count, int width,
                 float* sum) {
  ForEachBlock<kSumVectors>(0, width, [&](int lane, auto vectors) HWY_ATTR {
    SumBlock<vectors>(linear, members, count, lane, sum);
  });
}

// Runs kVectors vectors of neurons, from `lane` on. Calls on_spike(tick, v, mask) for each vector
// at each tick.
template <int kVectors, class OnSpike>
HWY_INLINE void RunLif(const Lif& lif, const float* bias, const Drive<float>& drive, int lane,
                       OnSpike on_spike) {
  const F32 d;
  const auto decay = hn::Set(d, lif.decay);
  const auto threshold = hn::Set(d, lif.threshold);
  const int ticks = drive.ticks;
  const int* offsets = drive.offsets.data();
  const float* const* terms = drive.terms.data();
  bias = Opaque(bias + lane);
  VecF membrane[kVectors];
  for (int v = 0; v < kVectors; ++v) membrane[v] = hn::Zero(d);
  for (int tick = 0, k = 0; tick < ticks; ++tick) {
    VecF current[kVectors];
    for (int v = 0; v < kVectors; ++v) current[v] = hn::LoadU(d, bias + v * kVector);
    for (const int end = offsets[tick + 1]; k < end; ++k) {
      const float* term = Opaque(terms[k] + lane);
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

void LifBitsImpl(const Lif& lif, const float* bias, const Drive<float>& drive, int first, int width,
                 uint32_t* bits) {
  const F32 d;
  uint8_t* const bytes = reinterpret_cast<uint8_t*>(bits);
  const size_t stride = width / 8;
  ForEachBlock<kLifVectors>(0, width, [&](int lane, auto vectors) HWY_ATTR {
    uint8_t* const block = bytes + lane / 8;
    RunLif<vectors>(lif, bias, drive, first + lane,
                    [d, block, stride](int tick, int v, auto spike)
                        HWY_ATTR { StoreMask(d, spike, block + tick * stride, v); });
  });
}

uint64_t LifRatesImpl(const Lif& lif, const float* bias, const Drive<float>& drive, int width,
                      float* rates) {
  const F32 d;
  const I32 di;
  const auto ticks = hn::Set(d, static_cast<float>(drive.ticks));
  auto total = hn::Zero(di);
  ForEachBlock<kLifVectors>(0, width, [&](int lane, auto vectors) HWY_ATTR {
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

const float* SumRows(const PackedLinear& linear, const int32_t* members, int count, int width,
                     float* sum) {
  if (count == 1) return linear.row(*members);
  HWY_DYNAMIC_DISPATCH(SumRowsImpl)(linear, members, count, width, sum);
  return sum;
}

void LifBits(const Lif& lif, const PackedLinear& linear, const Drive<float>& drive, int first,
             int width, uint32_t* bits) {
  HWY_DYNAMIC_DISPATCH(LifBitsImpl)(lif, linear.bias.data(), drive, first, width, bits);
}

uint64_t LifActivity(const Lif& lif, const PackedLinear& linear, const Drive<float>& drive,
                     float* rates) {
  return HWY_DYNAMIC_DISPATCH(LifRatesImpl)(lif, linear.bias.data(), drive, linear.width, rates);
}

uint64_t CountBits(const uint32_t* words, int count) {
  return HWY_DYNAMIC_DISPATCH(CountBitsImpl)(words, count);
}

}  // namespace spikeserve::kernels
#endif  // HWY_ONCE
