// Compares the integer kernels with plain loops at the ends of their ranges, on every SIMD target
// of this processor. The parity tests compare them on ordinary policies.
#include "core/engine/spiking/kernels/integer_kernels.h"

#include <gtest/gtest.h>

#include <limits>
#include <vector>

#include "core/engine/spiking/packed/packed_linear.h"
#include "core/math/counter_random.h"
#include "core/model/config.h"
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
  std::vector<std::vector<bool>> Spikes(const IntegerLif& lif) const {
    std::vector<std::vector<bool>> spikes(kTicks, std::vector<bool>(term.size()));
    for (size_t k = 0; k < term.size(); ++k) {
      int16_t membrane = 0;
      for (int tick = 0; tick < kTicks; ++tick) {
        const int current = population.bias[k] + (tick % 2 == 1 ? term[k] : 0);
        const auto threshold = static_cast<int16_t>(population.silent[k] + 1);
        spikes[tick][k] = lif.Step(static_cast<int16_t>(current), threshold, membrane);
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
      for (const int16_t decay : {0, 1, 16384, 31130, 32767}) {
        const IntegerLif lif = {decay};
        const auto spikes = extremes.Spikes(lif);
        std::vector<uint32_t> bits(static_cast<size_t>(kTicks) * width / 32);
        kernels::LifBits(lif, extremes.population, extremes.drive, 0, width, bits.data());
        std::vector<int16_t> counts(width);
        const uint64_t total =
            kernels::LifActivity(lif, extremes.population, extremes.drive, counts.data());
        uint64_t expected_total = 0;
        for (int k = 0; k < width; ++k) {
          int count = 0;
          for (int tick = 0; tick < kTicks; ++tick) {
            const uint32_t word = bits[(static_cast<size_t>(tick) * width + k) / 32];
            ASSERT_EQ((word >> (k % 32) & 1u) != 0, spikes[tick][k])
                << "neuron " << k << ", tick " << tick << ", decay " << decay;
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

// The largest sum that a valid policy can reach, 256 ticks and 16384 neurons, and those of the
// largest counts of 8 bits and of more.
TEST(IntegerKernelsTest, TheLargestCountsMapExactly) {
  OnEverySimdTarget([] {
    constexpr int kInputs = ModelLimits::kFfnSize;
    IntegerOutput output = {.weight = Int8Tensor::Zeros({3, kInputs}),
                            .scale = {.shape = {3}, .values = {1.0f, 0.5f, 3.0f}},
                            .bias = {.shape = {3}, .values = {0.0f, 1.0f, -7.0f}}};
    int32_t random_sum = 0;
    uint64_t nonzero = 2 * kInputs;
    for (int j = 0; j < kInputs; ++j) {
      output.weight.values[j] = 127;
      output.weight.values[kInputs + j] = -127;
      output.weight.values[2 * kInputs + j] = static_cast<int8_t>(Draw(255, 4, j) - 127);
      random_sum += output.weight.at(2, j);
      nonzero += output.weight.at(2, j) != 0;
    }
    for (const int ticks : {127, 128, ModelLimits::kTicks}) {
      const PackedIntegerOutput packed = Pack(output, ticks);
      const std::vector<int16_t> counts(kInputs, static_cast<int16_t>(ticks));
      std::vector<float> update(packed.width);
      kernels::ActiveInputs active;
      EXPECT_EQ(kernels::Affine(packed, counts.data(), &active, update.data()), nonzero);
      const auto expected = [&](int k, int32_t sum) {
        return output.scale.values[k] / static_cast<float>(ticks) *
                   static_cast<float>(sum * ticks) +
               output.bias.values[k];
      };
      EXPECT_EQ(update[0], expected(0, 127 * kInputs)) << ticks;
      EXPECT_EQ(update[1], expected(1, -127 * kInputs)) << ticks;
      EXPECT_EQ(update[2], expected(2, random_sum)) << ticks;
    }
  });
}

TEST(IntegerKernelsTest, CountsOfAnySparsityMapExactly) {
  OnEverySimdTarget([] {
    constexpr int kInputs = 69;
    constexpr int kOutputs = 72;
    IntegerOutput output = {.weight = Int8Tensor::Zeros({kOutputs, kInputs}),
                            .scale = Tensor::Zeros({kOutputs}),
                            .bias = Tensor::Zeros({kOutputs})};
    for (size_t i = 0; i < output.weight.values.size(); ++i) {
      output.weight.values[i] = static_cast<int8_t>(Draw(255, 5, i) - 127);
    }
    for (int k = 0; k < kOutputs; ++k) {
      output.scale.values[k] = 0.01f * static_cast<float>(1 + Draw(9, 6, k));
      output.bias.values[k] = static_cast<float>(Draw(9, 7, k));
    }
    const PackedIntegerOutput packed = Pack(output, 10);
    kernels::ActiveInputs active;
    for (const int one_in : {1, 2, 7, 40, 100}) {
      std::vector<int16_t> counts(PadToLanes(kInputs), 0);
      for (int j = 0; j < kInputs; ++j) {
        if (Draw(one_in, 8, j) == 0) counts[j] = static_cast<int16_t>(1 + Draw(10, 9, j));
      }
      std::vector<float> update(packed.width);
      kernels::Affine(packed, counts.data(), &active, update.data());
      for (int k = 0; k < kOutputs; ++k) {
        int32_t sum = 0;
        for (int j = 0; j < kInputs; ++j) sum += counts[j] * output.weight.at(k, j);
        ASSERT_EQ(update[k],
                  output.scale.values[k] / 10.0f * static_cast<float>(sum) + output.bias.values[k])
            << "output " << k << ", one in " << one_in;
      }
    }
  });
}

}  // namespace
}  // namespace spikeserve
