// Compares the integer kernels, those of the norm and of attention, too, with plain loops at the
// ends of their ranges, on every SIMD target of this processor. The parity tests compare them on
// ordinary policies.
#include <gtest/gtest.h>

#include <algorithm>
#include <cstdlib>
#include <limits>
#include <numeric>
#include <vector>

#include "core/engine/spiking/drive_builder.h"
#include "core/engine/spiking/kernels/event_kernels.h"
#include "core/engine/spiking/kernels/integer_attention_kernels.h"
#include "core/engine/spiking/kernels/norm_kernel.h"
#include "core/engine/spiking/packed/packed_linear.h"
#include "core/engine/spiking/spike_input.h"
#include "core/math/counter_random.h"
#include "core/math/fixed_point.h"
#include "core/neuron/lif.h"
#include "core/neuron/phase.h"
#include "tests/support/simd_targets.h"

namespace spikeserve {
namespace {

constexpr int kTicks = 40;

// Returns a number in [0, limit).
int Draw(int limit, uint64_t what, uint64_t index) {
  return static_cast<int>(RandomBits({what, index}) % static_cast<uint64_t>(limit));
}

// A population whose currents and thresholds are at or near the ends of their ranges, and a drive
// of one term at every second tick.
struct Extremes {
  explicit Extremes(int width) : term(width) {
    constexpr int kLargest = kLargestCurrent;
    population.width = population.outputs = width;
    for (int k = 0; k < width; ++k) {
      const int bias = std::vector{-kLargest, -1, 0, 1, kLargest / 2, kLargest}[Draw(6, 1, k)];
      const int most = kLargest - std::abs(bias);
      const int weight = std::vector{-most, 0, most / 3, most}[Draw(4, 2, k)];
      const int threshold = std::vector{1, 2, 16384, kLargest - 1, kLargest}[Draw(5, 3, k)];
      population.bias.push_back(static_cast<int16_t>(bias));
      population.silent.push_back(static_cast<int16_t>(threshold - 1));
      term[k] = static_cast<int16_t>(weight);
    }
    drive.ticks = kTicks;
    drive.offsets.push_back(0);
    for (int tick = 0; tick < kTicks; ++tick) {
      if (tick % 2 == 1) drive.terms.push_back(term.data());
      drive.offsets.push_back(static_cast<int>(drive.terms.size()));
    }
  }

  // Returns whether each neuron fires at each tick, [ticks][width].
  std::vector<std::vector<bool>> Spikes(const ShiftLif& lif) const {
    std::vector<std::vector<bool>> spikes(kTicks, std::vector<bool>(term.size()));
    for (size_t k = 0; k < term.size(); ++k) {
      int16_t membrane = 0;
      for (int tick = 0; tick < kTicks; ++tick) {
        lif.Leak(population.bias[k], membrane);
        if (tick % 2 == 0) continue;
        const auto threshold = static_cast<int16_t>(population.silent[k] + 1);
        spikes[tick][k] = ShiftLif::Charge(term[k], threshold, membrane);
      }
    }
    return spikes;
  }

  PackedIntegerPopulation population;
  AlignedVector<int16_t> term;
  kernels::Drive<int16_t> drive;
};

TEST(IntegerKernelsTest, NeuronsAtTheEndsOfTheirRangesEqualTheEquation) {
  OnEverySimdTarget([] {
    for (const int width : {32, 96, 512 + 32}) {
      const Extremes extremes(width);
      for (const int leak : {0, 1, 13, 16, 128}) {
        const ShiftLif lif = {leak};
        const auto spikes = extremes.Spikes(lif);
        std::vector<uint32_t> bits(static_cast<size_t>(kTicks) * width / 32);
        kernels::LifBits(lif, extremes.population, extremes.drive, 0, width, bits.data());
        std::vector<int16_t> counts(width);
        const uint64_t total =
            kernels::LifCounts(lif, extremes.population, extremes.drive, 0, width, counts.data());
        uint64_t expected_total = 0;
        for (int k = 0; k < width; ++k) {
          int count = 0;
          for (int tick = 0; tick < kTicks; ++tick) {
            const uint32_t word = bits[(static_cast<size_t>(tick) * width + k) / 32];
            ASSERT_EQ((word >> (k % 32) & 1u) != 0, spikes[tick][k])
                << "neuron " << k << ", tick " << tick << ", leak " << leak;
            count += spikes[tick][k];
          }
          ASSERT_EQ(counts[k], count) << "neuron " << k;
          expected_total += count;
        }
        EXPECT_EQ(total, expected_total);
      }
    }
  });
}

TEST(IntegerKernelsTest, RowsOfTheLargestWeightsAddUpExactly) {
  OnEverySimdTarget([] {
    constexpr int kRows = 258;  // 258 x 127 = 32766
    PackedIntegerPopulation population;
    population.inputs = kRows;
    population.width = 416;
    std::vector<int32_t> members;
    AlignedVector<int8_t> rows;
    for (int j = 0; j < kRows; ++j) {
      for (int k = 0; k < population.width; ++k) {
        rows.push_back(k % 2 == 0 ? int8_t{127} : int8_t{-127});
      }
      members.push_back(j);
    }
    population.rows = std::move(rows);
    std::vector<int16_t> sum(population.width);
    for (const int count : {1, 2, 257, kRows}) {
      kernels::SumRows(population, members.data(), count, population.width, sum.data());
      for (int k = 0; k < population.width; ++k) {
        ASSERT_EQ(sum[k], (k % 2 == 0 ? 127 : -127) * count) << "lane " << k;
      }
    }
  });
}

// Returns a number from `low` to `high`.
int Draw(int low, int high, uint64_t what, int index) {
  const auto count = static_cast<uint64_t>(int64_t{high} - low + 1);
  return low + static_cast<int>(RandomBits({what, static_cast<uint64_t>(index)}) % count);
}

// Returns norm(x) as docs/design/integer.md defines it.
std::vector<int16_t> Norm(const PackedNorm& norm, std::vector<int64_t> x) {
  int64_t total = 0;
  for (int64_t& a : x) total += a = SaturateResidual(a);
  uint64_t squares = 0;
  for (int64_t& c : x) {
    c -= RoundDivide(total, norm.size);
    squares += static_cast<uint64_t>(c * c);
  }
  const InverseRoot root = InverseRootOf(squares);
  std::vector<int16_t> y(norm.width);
  for (int k = 0; k < norm.size; ++k) {
    const int64_t unit = root.Normalise(static_cast<int32_t>(x[k]));
    y[k] = static_cast<int16_t>(
        SaturateResidual(RoundShift(unit * norm.weight[k], norm.shift) + norm.bias[k]));
  }
  return y;
}

TEST(FixedPointKernelsTest, NormsOfAllMagnitudesEqualTheEquation) {
  OnEverySimdTarget([] {
    for (const int size : {1, 31, 64, 129}) {
      for (int bits = 0; bits <= 17; ++bits) {  // of the sums
        PackedNorm norm;
        norm.size = size;
        norm.width = PadToLanes(size);
        norm.shift = bits % 16;
        norm.weight.resize(norm.width);
        norm.bias.resize(norm.width);
        std::vector<int16_t> x(norm.width);
        std::vector<int32_t> sums(norm.width);
        std::vector<int64_t> added(size);
        for (int k = 0; k < size; ++k) {
          norm.weight[k] = static_cast<int16_t>(Draw(-32767, 32767, 1, k));
          norm.bias[k] = static_cast<int16_t>(Draw(-32767, 32767, 2, k));
          x[k] = static_cast<int16_t>(bits < 15 ? 0 : Draw(-32767, 32767, 3, k));
          sums[k] = Draw(0, 1 << bits, 4, k);
          added[k] = int64_t{x[k]} + sums[k];
        }
        const std::vector<int16_t> expected = Norm(norm, added);
        kernels::Normalize(norm, sums.data(), x.data());
        EXPECT_EQ(x, expected) << size << " numbers of " << bits << " bits";
      }
    }
  });
}

TEST(FixedPointKernelsTest, WithoutANormTheStreamStaysWithinItsLimits) {
  OnEverySimdTarget([] {
    for (const int size : {1, 31, 64, 129}) {
      const int width = PadToLanes(size);
      std::vector<int16_t> x(width), expected(width);
      std::vector<int32_t> sums(width);
      for (int k = 0; k < size; ++k) {
        x[k] = static_cast<int16_t>(Draw(-32767, 32767, 1, k));
        sums[k] = Draw(-(1 << 30), 1 << 30, 2, k) >> (k % 16);
        expected[k] = static_cast<int16_t>(SaturateResidual(int64_t{x[k]} + sums[k]));
      }
      sums[0] = 2147483647 - 32767;  // the largest sum that a policy file allows
      expected[0] = 32767;
      kernels::AddLimited(width, sums.data(), x.data());
      EXPECT_EQ(x, expected) << size;
    }
  });
}

TEST(FixedPointKernelsTest, SquareRootsAreRoundedDown) {
  for (const uint32_t root : {1u, 2u, 255u, 32768u, 46341u, 65534u, 65535u}) {
    EXPECT_EQ(SquareRoot(root * root), root);
    EXPECT_EQ(SquareRoot(root * root - 1), root - 1);
    EXPECT_EQ(SquareRoot(root * root + 2 * root), root);
  }
}

TEST(FixedPointKernelsTest, QuotientsOfAllDivisorsAreExact) {
  OnEverySimdTarget([] {
    std::vector<int> divisors = {1,       2,         3, 77, 600, 65535, 7680001, (1 << 29) - 1,
                                 1 << 29, 2147483647};
    // Large ones, whose reciprocals float32 rounds up and down. Half of them have exact halves.
    for (int i = 0; i < 64; ++i) {
      divisors.push_back(Draw(1 << 28, (1 << 29) - 1, 7, i) & (i % 2 == 0 ? -1 : -512));
    }
    for (const int divisor : divisors) {
      constexpr int kSize = 75;
      std::vector<int32_t> sums(PadToLanes(kSize), -1);  // what is behind the head does not matter
      for (int k = 0; k < kSize; ++k) {
        // Near the sums at which a quotient changes, which are those of an odd multiple of half.
        const int64_t edge = (int64_t{divisor} * (2 * Draw(0, 255, 5, k) + 1)) >> 9;
        sums[k] = static_cast<int32_t>(std::clamp<int64_t>(edge + k % 4 - 1, 0, divisor));
      }
      sums[0] = divisor;
      std::vector<int16_t> y(kSize + 1, -7);
      const int nonzero = kernels::ScaleSums(sums.data(), kSize, divisor, y.data());
      EXPECT_EQ(nonzero, kSize - std::count(sums.begin(), sums.begin() + kSize, 0));
      for (int k = 0; k < kSize; ++k) {
        const int64_t expected =
            std::min<int64_t>(255, RoundDivide(int64_t{sums[k]} << 8, divisor));
        EXPECT_EQ(y[k], expected) << sums[k] << " / " << divisor;
      }
      EXPECT_EQ(y[kSize], -7) << "the next head";
    }
  });
}

TEST(FixedPointKernelsTest, WeightsOfKeysEqualTheEquation) {
  OnEverySimdTarget([] {
    for (const int scale : {-32768, -300, -1, 0, 1, 40, 256, 32767}) {
      for (const int slots : {16, 32, 64}) {
        AlignedVector<int32_t> overlaps(slots);
        AlignedVector<int32_t> held(slots);
        std::vector<int32_t> seen;
        for (int i = 0; i < slots; ++i) {
          overlaps[i] = Draw(0, i % 3 == 0 ? 40 : 1 << 20, 6, i);
          held[i] = -(i == 5 || Draw(0, 3, 7, i) > 0);
          if (held[i] != 0) seen.push_back(overlaps[i]);
        }
        const auto [low, high] = std::minmax_element(seen.begin(), seen.end());
        const int64_t best = scale >= 0 ? *high : *low;
        std::vector<int16_t> expected(slots);
        for (int i = 0; i < slots; ++i) {
          const int64_t octaves = RoundShift(std::abs(overlaps[i] - best) * std::abs(scale), 8);
          if (held[i] != 0 && octaves <= 8) expected[i] = static_cast<int16_t>(256 >> octaves);
        }
        std::vector<int16_t> weights(slots, -7);
        EXPECT_EQ(kernels::Shiftmax(scale, overlaps.data(), held.data(), slots, weights.data()),
                  std::accumulate(expected.begin(), expected.end(), 0))
            << scale;
        EXPECT_EQ(weights, expected) << scale;
      }
    }
  });
}

constexpr int64_t kTimestep = 17;

// The terms of a current are added in a fixed order. A wrong order rarely changes a spike, so these
// tests compare the currents.
class SpikeInputTest : public testing::Test {
 protected:
  SpikeInputTest() {
    policy_ = RandomPolicy(config_, 4, ActionSpace::Discrete(2), 5);
    for (int j = 0; j < config_.hidden_size; ++j) {
      x_.push_back(4.0f * UniformFloat(RandomBits({9, static_cast<uint64_t>(j)})) - 1.0f);
    }
    phase_.Set(policy_, kTimestep);
    input_.Code(config_, PeriodTable(Lif(), config_.ticks), Coder(), x_.data());
  }

  const struct Coder& Coder() const { return policy_.weights.layers[0].coder; }

  int Period(int j) const {
    return Lif().Period(x_[j] * Coder().gain.values[j] + Coder().bias.values[j], config_.ticks);
  }

  // Returns the current into output i, added up in the canonical order: the bias; then one sum for
  // the neurons of each period that divides the tick; then the phase spikes one by one.
  float Current(const Linear& linear, int i, int tick) const {
    float current = linear.bias.values[i];
    for (int n = 1; n <= tick; ++n) {
      if (tick % n != 0) continue;
      float group = 0.0f;
      for (int j = 0; j < config_.hidden_size; ++j) {
        if (Period(j) == n) group += linear.weight.at(i, j);
      }
      current += group;
    }
    for (int k = 0; k < config_.heads; ++k) {
      const double time = TimestepPhaseTime(kTimestep, tick - 1, config_.ticks);
      if (PhaseSpike(policy_.weights.phase_omega.values[k], policy_.weights.phase_phi.values[k],
                     time)) {
        current += linear.weight.at(i, config_.hidden_size + k);
      }
    }
    return current;
  }

  ModelConfig config_;
  Policy policy_;
  std::vector<float> x_;
  PhaseSpikes phase_;
  SpikeInput input_;
};

TEST_F(SpikeInputTest, CurrentsAddUpInTheCanonicalOrder) {
  const Linear& key = policy_.weights.layers[0].key;
  const PackedLinear packed = Pack({&key});
  DriveBuilder<float> builder;
  const kernels::Drive<float>& drive = builder.Build(input_, packed, packed.width, &phase_);
  for (int tick = 1; tick <= config_.ticks; ++tick) {
    for (int i = 0; i < config_.hidden_size; ++i) {
      float current = packed.bias[i];
      for (int k = drive.offsets[tick - 1]; k < drive.offsets[tick]; ++k)
        current += drive.terms[k][i];
      ASSERT_EQ(current, Current(key, i, tick)) << "tick " << tick << ", output " << i;
    }
  }
}

}  // namespace
}  // namespace spikeserve
