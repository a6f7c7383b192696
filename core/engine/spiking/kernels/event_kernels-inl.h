// The kernels of event_kernels.h. Only integer_kernels.cc may include it, which compiles it once
// per SIMD target.
#include <algorithm>

#include "core/engine/spiking/kernels/event_kernels.h"
#include "core/engine/spiking/kernels/simd/integer_vectors-inl.h"
#include "core/engine/spiking/kernels/simd/vectors-inl.h"
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {
namespace {

// Number of vectors of neurons that run together; see lif_kernels-inl.h.
constexpr int kLifVectors = kManyRegisters ? 8 : 4;
// Number of vectors of a row that are added in one pass over the rows; see lif_kernels-inl.h.
constexpr int kSumVectors = kManyRegisters ? 12 : 8;

void CoderPeriodsImpl(const PackedPeriodCoder& coder, const int16_t* x, int32_t* periods,
                      uint32_t* active) {
  const I16 d;
  const I32 di;
  uint8_t* const bytes = reinterpret_cast<uint8_t*>(active);
  const auto one = hn::Set(d, int16_t{1});
  for (int j = 0; j < coder.width; j += kVector16) {
    const auto value = hn::Mul(hn::LoadU(d, x + j), hn::LoadU(d, coder.sign.data() + j));
    const int16_t* threshold = coder.threshold.data() + j;
    // Thresholds never increase with the period, so the last one shows whether the neuron fires.
    const auto fires =
        hn::Gt(value, hn::LoadU(d, threshold + static_cast<size_t>(coder.ticks - 1) * coder.width));
    StoreMask(d, fires, bytes, j / kVector16);
    if (hn::AllFalse(d, fires)) {
      std::fill_n(periods + j, kVector16, 0);
      continue;
    }
    auto period = one;
    for (int n = 0; n < coder.ticks; ++n) {
      const auto reached =
          hn::Gt(value, hn::LoadU(d, threshold + static_cast<size_t>(n) * coder.width));
      period = hn::Add(period, hn::IfThenZeroElse(reached, one));
    }
    const auto found = hn::IfThenElseZero(fires, period);
    const hn::Half<I16> half;
    hn::StoreU(hn::PromoteTo(di, hn::LowerHalf(half, found)), di, periods + j);
    hn::StoreU(hn::PromoteTo(di, hn::UpperHalf(half, found)), di, periods + j + kVector);
  }
}

// Adds kVectors vectors of each row, from `lane` on.
template <int kVectors>
HWY_INLINE void SumBlock(const PackedIntegerPopulation& population, const int32_t* members,
                         int count, int lane, int16_t* sum) {
  const I16 d;
  VecI16 total[kVectors];
  const int8_t* first = population.row(members[0]) + lane;
  for (int v = 0; v < kVectors; ++v) total[v] = LoadWide(first + v * kVector16);
  for (int m = 1; m < count; ++m) {
    const int8_t* row = Opaque(population.row(members[m]) + lane);
    for (int v = 0; v < kVectors; ++v) {
      total[v] = hn::Add(total[v], LoadWide(row + v * kVector16));
    }
  }
  for (int v = 0; v < kVectors; ++v) hn::StoreU(total[v], d, sum + lane + v * kVector16);
}

void SumRowsImpl(const PackedIntegerPopulation& population, const int32_t* members, int count,
                 int width, int16_t* sum) {
  ForEachBlock<kSumVectors, kVector16>(0, width, [&](int lane, auto vectors) HWY_ATTR {
    SumBlock<vectors>(population, members, count, lane, sum);
  });
}

// Runs kVectors vectors of neurons, from `lane` on, until the last tick with an input spike. Calls
// on_spike(tick, v, spike) for each vector at each tick with an input spike, in which a lane that
// fires is -1 and the others are 0.
template <int kVectors, class OnSpike>
HWY_INLINE void RunLif(const ShiftLif& lif, const PackedIntegerPopulation& population,
                       const Drive<int16_t>& drive, int last_tick, int lane, OnSpike on_spike) {
  const I16 d;
  // A product with it is rounded as RoundShift(V * leak, 8).
  const auto leak = hn::Set(d, static_cast<int16_t>(lif.leak * 128));
  const int* offsets = drive.offsets.data();
  const int16_t* const* terms = drive.terms.data();
  const int16_t* bias = Opaque(population.bias.data() + lane);
  const int16_t* silent = Opaque(population.silent.data() + lane);
  VecI16 membrane[kVectors];
  for (int v = 0; v < kVectors; ++v) membrane[v] = hn::Zero(d);
  for (int tick = 0, k = 0; tick < last_tick; ++tick) {
    for (int v = 0; v < kVectors; ++v) {
      membrane[v] = hn::Sub(membrane[v], hn::MulFixedPoint15(membrane[v], leak));
      membrane[v] = hn::SaturatedAdd(membrane[v], hn::LoadU(d, bias + v * kVector16));
    }
    const int end = offsets[tick + 1];
    if (k == end) continue;
    VecI16 current[kVectors];
    const int16_t* first = Opaque(terms[k] + lane);
    for (int v = 0; v < kVectors; ++v) current[v] = hn::LoadU(d, first + v * kVector16);
    for (++k; k < end; ++k) {
      const int16_t* term = Opaque(terms[k] + lane);
      for (int v = 0; v < kVectors; ++v) {
        current[v] = hn::Add(current[v], hn::LoadU(d, term + v * kVector16));
      }
    }
    for (int v = 0; v < kVectors; ++v) {
      membrane[v] = hn::SaturatedAdd(membrane[v], current[v]);
      const auto margin = hn::SaturatedSub(hn::LoadU(d, silent + v * kVector16), membrane[v]);
      const auto spike = hn::BroadcastSignBit(margin);
      membrane[v] = hn::AndNot(spike, membrane[v]);
      on_spike(tick, v, spike);
    }
  }
}

// Returns the number of ticks up to the last one with an input spike.
HWY_INLINE int LastTick(const Drive<int16_t>& drive) {
  int ticks = drive.ticks;
  while (ticks > 0 && drive.offsets[ticks] == drive.offsets[ticks - 1]) --ticks;
  return ticks;
}

void LifBitsImpl(const ShiftLif& lif, const PackedIntegerPopulation& population,
                 const Drive<int16_t>& drive, int first, int width, uint32_t* bits) {
  const I16 d;
  const int last_tick = LastTick(drive);
  std::fill_n(bits, static_cast<size_t>(drive.ticks) * width / 32, 0u);
  uint8_t* const bytes = reinterpret_cast<uint8_t*>(bits);
  const size_t stride = width / 8;
  ForEachBlock<kLifVectors, kVector16>(0, width, [&](int lane, auto vectors) HWY_ATTR {
    uint8_t* const block = bytes + lane / 8;
    RunLif<vectors>(lif, population, drive, last_tick, first + lane,
                    [d, block, stride](int tick, int v, auto spike) HWY_ATTR {
                      StoreMask(d, hn::MaskFromVec(spike), block + tick * stride, v);
                    });
  });
}

uint64_t LifCountsImpl(const ShiftLif& lif, const PackedIntegerPopulation& population,
                       const Drive<int16_t>& drive, int first, int width, int16_t* counts) {
  const I16 d;
  const int last_tick = LastTick(drive);
  ForEachBlock<kLifVectors, kVector16>(0, width, [&](int lane, auto vectors) HWY_ATTR {
    VecI16 count[vectors];
    for (int v = 0; v < vectors; ++v) count[v] = hn::Zero(d);
    RunLif<vectors>(lif, population, drive, last_tick, first + lane,
                    [&](int, int v, auto spike) HWY_ATTR {
                      count[v] = hn::Sub(count[v], spike);  // a lane that fires is -1
                    });
    for (int v = 0; v < vectors; ++v) hn::StoreU(count[v], d, counts + lane + v * kVector16);
  });
  return SumCounts(counts, width);
}

uint64_t ApplyImpl(const PackedFixedPointMap& map, const int16_t* input, ActiveInputs* active,
                   int32_t* output) {
  const I32 di;
  const I16 d16;
  const uint64_t products = FindActive(map, input, *active);
  ForEachBlock<8>(0, map.width, [&](int lane, auto vectors) HWY_ATTR {
    PairSum total[vectors];
    for (const int32_t pair : *active) {
      int32_t both;
      std::memcpy(&both, input + 2 * pair, sizeof(both));
      const auto activation = hn::BitCast(d16, hn::Set(di, both));
      const int8_t* row = Opaque(map.row(pair) + 2 * lane);
      for (int v = 0; v < vectors; ++v) {
        total[v].Add(LoadWide(row + v * kVector16), activation);
      }
    }
    for (int v = 0; v < vectors; ++v) {
      const int k = lane + v * kVector;
      const auto shifted = hn::Shl(total[v].Total(), hn::LoadU(di, map.left.data() + k));
      const auto rounded = hn::Add(shifted, hn::LoadU(di, map.rounding.data() + k));
      const auto result = hn::Shr(rounded, hn::LoadU(di, map.right.data() + k));
      hn::StoreU(hn::Add(result, hn::LoadU(di, map.bias.data() + k)), di, output + k);
    }
  });
  return products;
}

}  // namespace
}  // namespace spikeserve::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace spikeserve::kernels {

HWY_EXPORT(CoderPeriodsImpl);
HWY_EXPORT(SumRowsImpl);
HWY_EXPORT(LifBitsImpl);
HWY_EXPORT(LifCountsImpl);
HWY_EXPORT(ApplyImpl);

void CoderPeriods(const PackedPeriodCoder& coder, const int16_t* x, int32_t* periods,
                  uint32_t* active) {
  HWY_DYNAMIC_DISPATCH(CoderPeriodsImpl)(coder, x, periods, active);
}

const int16_t* SumRows(const PackedIntegerPopulation& population, const int32_t* members, int count,
                       int width, int16_t* sum) {
  HWY_DYNAMIC_DISPATCH(SumRowsImpl)(population, members, count, width, sum);
  return sum;
}

void LifBits(const ShiftLif& lif, const PackedIntegerPopulation& population,
             const Drive<int16_t>& drive, int first, int width, uint32_t* bits) {
  HWY_DYNAMIC_DISPATCH(LifBitsImpl)(lif, population, drive, first, width, bits);
}

uint64_t LifCounts(const ShiftLif& lif, const PackedIntegerPopulation& population,
                   const Drive<int16_t>& drive, int first, int width, int16_t* counts) {
  return HWY_DYNAMIC_DISPATCH(LifCountsImpl)(lif, population, drive, first, width, counts);
}

uint64_t Apply(const PackedFixedPointMap& map, const int16_t* input, ActiveInputs* active,
               int32_t* output) {
  return HWY_DYNAMIC_DISPATCH(ApplyImpl)(map, input, active, output);
}

}  // namespace spikeserve::kernels
#endif  // HWY_ONCE
