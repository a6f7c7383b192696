// Compares the kernels of the integer norm and of integer attention with plain loops at the ends of
// their ranges, on every SIMD target of this processor.

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdlib>
#include <numeric>
#include <vector>

#include "core/engine/spiking/kernels/integer_attention_kernels.h"
#include "core/engine/spiking/kernels/norm_kernel.h"
#include "core/engine/spiking/packed/packed_linear.h"
#include "core/math/counter_random.h"
#include "core/math/fixed_point.h"
#include "tests/support/simd_targets.h"

namespace spikeserve {
namespace {

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

}  // namespace
}  // namespace spikeserve
