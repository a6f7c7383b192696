// Compares the integer kernels with plain loops at the ends of their ranges, on every SIMD target
// of this processor. The parity tests compare them on ordinary policies.
#include <gtest/gtest.h>

#include <limits>
#include <vector>

#include "core/engine/spiking/kernels/event_kernels.h"
#include "core/engine/spiking/packed/packed_linear.h"
#include "core/math/counter_random.h"
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

}  // namespace
}  // namespace spikeserve
