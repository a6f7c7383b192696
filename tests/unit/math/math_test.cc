#include <gtest/gtest.h>

#include <cmath>
#include <set>
#include <vector>

#include "core/math/counter_random.h"
#include "core/math/exp.h"
#include "core/math/layer_norm.h"

namespace spikeserve {
namespace {

TEST(ExpTest, IsWithinTwoUnitsInTheLastPlace) {
  for (double x = -86.9; x < 87.9; x += 0.00137) {
    const auto argument = static_cast<float>(x);
    const auto exact = static_cast<float>(std::exp(static_cast<double>(argument)));
    const float unit = std::nextafter(exact, INFINITY) - exact;
    ASSERT_LE(std::abs(Exp(argument) - exact), 2.0f * unit) << argument;
  }
}

TEST(ExpTest, IsExactAtZeroAndFiniteAtTheEnds) {
  EXPECT_EQ(Exp(0.0f), 1.0f);
  EXPECT_GT(Exp(-1e30f), 0.0f);
  EXPECT_TRUE(std::isfinite(Exp(1e30f)));
}

TEST(ExpTest, OfNanIsNan) { EXPECT_TRUE(std::isnan(Exp(NAN))); }

TEST(ExpTest, SigmoidAndTanhFollow) {
  for (float x = -20.0f; x < 20.0f; x += 0.01f) {
    EXPECT_NEAR(Sigmoid(x), 1.0 / (1.0 + std::exp(-static_cast<double>(x))), 1e-6) << x;
    EXPECT_NEAR(Tanh(x), std::tanh(static_cast<double>(x)), 1e-6) << x;
  }
}

TEST(LayerNormTest, OrderedSumFoldsSixteenInterleavedPartialSums) {
  // In float32, 1e8 + 1 rounds to 1e8, so the result shows which elements share a partial sum.
  std::vector<float> values(32, 0.0f);
  values[0] = 1e8f;
  values[16] = 1.0f;  // in the partial sum of element 0: lost by rounding
  values[17] = 3.0f;  // in the partial sum of element 1; added to 1e8 alone, it would be lost
  values[1] = 5.0f;   // 5 + 3 = 8 is large enough to survive the addition to 1e8
  EXPECT_EQ(OrderedSum(values.data(), values.size()), 1e8f + 8.0f);
}

TEST(LayerNormTest, CentresScalesAndShifts) {
  for (const size_t size : {5, 16, 37, 128}) {
    std::vector<float> x(size), weight(size), bias(size);
    for (size_t i = 0; i < size; ++i) {
      x[i] = UniformFloat(RandomBits({1, i})) * 3.0f - 1.0f;
      weight[i] = UniformFloat(RandomBits({2, i}));
      bias[i] = UniformFloat(RandomBits({3, i}));
    }
    double mean = 0.0, variance = 0.0;
    for (const float value : x) mean += value / static_cast<double>(size);
    for (const float value : x)
      variance += (value - mean) * (value - mean) / static_cast<double>(size);
    std::vector<float> y = x;
    LayerNorm(weight.data(), bias.data(), y.data(), size);
    for (size_t i = 0; i < size; ++i) {
      EXPECT_NEAR(y[i], (x[i] - mean) / std::sqrt(variance + 1e-5) * weight[i] + bias[i], 1e-5);
    }
  }
}

TEST(CounterRandomTest, KeysOfDifferentOrderOrLengthDiffer) {
  const std::set<uint64_t> draws = {RandomBits({1, 2}), RandomBits({2, 1}), RandomBits({1, 2, 0}),
                                    RandomBits({1}), RandomBits({2})};
  EXPECT_EQ(draws.size(), 5u);
}

TEST(CounterRandomTest, UniformDrawsFillTheUnitInterval) {
  double sum = 0.0;
  constexpr int kDraws = 10000;
  for (uint64_t i = 0; i < kDraws; ++i) {
    const float draw = UniformFloat(RandomBits({42, i}));
    ASSERT_GE(draw, 0.0f);
    ASSERT_LT(draw, 1.0f);
    sum += draw;
  }
  EXPECT_NEAR(sum / kDraws, 0.5, 0.01);
}

}  // namespace
}  // namespace spikeserve
