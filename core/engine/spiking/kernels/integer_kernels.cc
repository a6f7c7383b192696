#include "core/engine/spiking/kernels/integer_kernels.h"

#include <vector>

#include "core/engine/spiking/kernels/sdot_kernel.h"
#include "core/engine/spiking/kernels/targets.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/engine/spiking/kernels/integer_kernels.cc"
// clang-format off
#include "hwy/foreach_target.h"  // must come first: compiles the rest of this file once per target
// clang-format on
#include "core/engine/spiking/kernels/simd/integer_vectors-inl.h"
#include "core/engine/spiking/kernels/simd/vectors-inl.h"
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {
namespace {

// Number of vectors of neurons that run together, and of vectors of a row that are added in one
// pass over the rows; see lif_kernels.cc.
constexpr int kLifVectors = kManyRegisters ? 8 : 4;
constexpr int kSumVectors = kManyRegisters ? 12 : 8;

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

// Runs kVectors vectors of neurons, from `lane` on. Calls on_spike(tick, v, spike) for each vector
// at each tick, in which a lane that fires is -1 and the others are 0.
template <int kVectors, class OnSpike>
HWY_INLINE void RunLif(const IntegerLif& lif, const PackedIntegerPopulation& population,
                       const Drive<int16_t>& drive, int lane, OnSpike on_spike) {
  const I16 d;
  const auto decay = hn::Set(d, lif.decay);
  const int* offsets = drive.offsets.data();
  const int16_t* const* terms = drive.terms.data();
  const int16_t* bias = Opaque(population.bias.data() + lane);
  const int16_t* silent = Opaque(population.silent.data() + lane);
  VecI16 membrane[kVectors];
  for (int v = 0; v < kVectors; ++v) membrane[v] = hn::Zero(d);
  for (int tick = 0, k = 0; tick < drive.ticks; ++tick) {
    VecI16 current[kVectors];
    for (int v = 0; v < kVectors; ++v) current[v] = hn::LoadU(d, bias + v * kVector16);
    for (const int end = offsets[tick + 1]; k < end; ++k) {
      const int16_t* term = Opaque(terms[k] + lane);
      for (int v = 0; v < kVectors; ++v) {
        current[v] = hn::Add(current[v], hn::LoadU(d, term + v * kVector16));
      }
    }
    for (int v = 0; v < kVectors; ++v) {
      membrane[v] = hn::SaturatedAdd(hn::MulFixedPoint15(decay, membrane[v]), current[v]);
      // All bits of a lane are set if it fires. No mask register lies between two ticks, because
      // moving a comparison there and back takes longer than the update itself.
      const auto margin = hn::SaturatedSub(hn::LoadU(d, silent + v * kVector16), membrane[v]);
      const auto spike = hn::BroadcastSignBit(margin);
      membrane[v] = hn::AndNot(spike, membrane[v]);
      on_spike(tick, v, spike);
    }
  }
}

void LifBitsImpl(const IntegerLif& lif, const PackedIntegerPopulation& population,
                 const Drive<int16_t>& drive, int first, int width, uint32_t* bits) {
  const I16 d;
  uint8_t* const bytes = reinterpret_cast<uint8_t*>(bits);
  const size_t stride = width / 8;
  ForEachBlock<kLifVectors, kVector16>(0, width, [&](int lane, auto vectors) HWY_ATTR {
    uint8_t* const block = bytes + lane / 8;
    RunLif<vectors>(lif, population, drive, first + lane,
                    [d, block, stride](int tick, int v, auto spike) HWY_ATTR {
                      StoreMask(d, hn::MaskFromVec(spike), block + tick * stride, v);
                    });
  });
}

uint64_t AffineImpl(const PackedIntegerOutput& output, const int16_t* counts, ActiveInputs* active,
                    float* update) {
  const F32 d;
  const I32 di;
  const I16 d16;
  const uint64_t products = FindActive(output, counts, *active);
#if HWY_ARCH_ARM_A64 && HWY_TARGET != HWY_EMU128
  if (output.narrow_counts && UsesSdot()) {
    AffineBySdot({output.rows.data(), output.factor.data(), output.bias.data(), output.width},
                 counts, active->data(), active->size(), update);
    return products;
  }
#endif
  ForEachBlock<8>(0, output.width, [&](int lane, auto vectors) HWY_ATTR {
    PairSum total[vectors];
    for (const int32_t pair : *active) {
      int32_t both;
      std::memcpy(&both, counts + 2 * pair, sizeof(both));
      const auto count = hn::BitCast(d16, hn::Set(di, both));
      const int8_t* row = Opaque(output.row(pair) + 2 * lane);
      for (int v = 0; v < vectors; ++v) {
        total[v].Add(LoadWide(row + v * kVector16), count);
      }
    }
    for (int v = 0; v < vectors; ++v) {
      const int k = lane + v * kVector;
      const auto scaled =
          hn::Mul(hn::LoadU(d, output.factor.data() + k), hn::ConvertTo(d, total[v].Total()));
      hn::StoreU(hn::Add(scaled, hn::LoadU(d, output.bias.data() + k)), d, update + k);
    }
  });
  return products;
}

uint64_t LifActivityImpl(const IntegerLif& lif, const PackedIntegerPopulation& population,
                         const Drive<int16_t>& drive, int16_t* counts) {
  const I16 d;
  ForEachBlock<kLifVectors, kVector16>(0, population.width, [&](int lane, auto vectors) HWY_ATTR {
    VecI16 count[vectors];
    for (int v = 0; v < vectors; ++v) count[v] = hn::Zero(d);
    RunLif<vectors>(lif, population, drive, lane, [&](int, int v, auto spike) HWY_ATTR {
      count[v] = hn::Sub(count[v], spike);  // a lane that fires is -1
    });
    for (int v = 0; v < vectors; ++v) hn::StoreU(count[v], d, counts + lane + v * kVector16);
  });
  return SumCounts(counts, population.width);
}

}  // namespace
}  // namespace spikeserve::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace spikeserve::kernels {

HWY_EXPORT(SumRowsImpl);
HWY_EXPORT(LifBitsImpl);
HWY_EXPORT(LifActivityImpl);
HWY_EXPORT(AffineImpl);

const int16_t* SumRows(const PackedIntegerPopulation& population, const int32_t* members, int count,
                       int width, int16_t* sum) {
  HWY_DYNAMIC_DISPATCH(SumRowsImpl)(population, members, count, width, sum);
  return sum;
}

void LifBits(const IntegerLif& lif, const PackedIntegerPopulation& population,
             const Drive<int16_t>& drive, int first, int width, uint32_t* bits) {
  HWY_DYNAMIC_DISPATCH(LifBitsImpl)(lif, population, drive, first, width, bits);
}

uint64_t LifActivity(const IntegerLif& lif, const PackedIntegerPopulation& population,
                     const Drive<int16_t>& drive, int16_t* counts) {
  return HWY_DYNAMIC_DISPATCH(LifActivityImpl)(lif, population, drive, counts);
}

uint64_t Affine(const PackedIntegerOutput& output, const int16_t* counts, ActiveInputs* active,
                float* update) {
  return HWY_DYNAMIC_DISPATCH(AffineImpl)(output, counts, active, update);
}

}  // namespace spikeserve::kernels
#endif  // HWY_ONCE
