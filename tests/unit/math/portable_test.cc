// Tests the portable functions against the C library's in extended precision, and that their bits
// are those of every other processor.
#include "core/math/portable.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numbers>

#include "core/math/counter_random.h"

namespace spikeserve::portable {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr int kDraws = 20'000;

// Returns a number in [low, high).
double Draw(uint64_t what, int i, double low, double high) {
  return low + (high - low) * UniformDouble(RandomBits({what, static_cast<uint64_t>(i)}));
}

// Returns |actual - exact| in units in the last place of `exact`.
double Error(double actual, long double exact) {
  const auto rounded = static_cast<double>(exact);
  const double unit = std::nextafter(std::abs(rounded), kInfinity) - std::abs(rounded);
  return static_cast<double>(std::abs(actual - exact) / unit);
}

TEST(PortableTest, LogIsWithinAUnit) {
  for (int i = 0; i < kDraws; ++i) {
    const double anywhere = std::ldexp(Draw(1, i, 1.0, 2.0), i % 2000 - 1000);
    const double near_one = Draw(2, i, 0.7, 1.5);
    for (const double x : {anywhere, near_one}) {
      ASSERT_LE(Error(Log(x), std::log(static_cast<long double>(x))), 1.0) << x;
    }
  }
  EXPECT_EQ(Log(1.0), 0.0);
  EXPECT_EQ(Log(0.0), -kInfinity);
  EXPECT_EQ(Log(kInfinity), kInfinity);
  EXPECT_TRUE(std::isnan(Log(-1.0)));
  EXPECT_TRUE(std::isnan(Log(std::numeric_limits<double>::quiet_NaN())));
  EXPECT_LE(Error(Log(5e-324), std::log(static_cast<long double>(5e-324))), 1.0);
}

TEST(PortableTest, ExpIsWithinTwoUnits) {
  for (int i = 0; i < kDraws; ++i) {
    for (const double x : {Draw(3, i, -700.0, 709.0), Draw(4, i, -1.0, 1.0)}) {
      ASSERT_LE(Error(Exp(x), std::exp(static_cast<long double>(x))), 2.0) << x;
    }
  }
  EXPECT_EQ(Exp(0.0), 1.0);
  EXPECT_EQ(Exp(-kInfinity), 0.0);
  EXPECT_EQ(Exp(710.0), kInfinity);
  EXPECT_TRUE(std::isnan(Exp(std::numeric_limits<double>::quiet_NaN())));
}

TEST(PortableTest, CosOfTurnsIsWithinItsBound) {
  for (int i = 0; i < kDraws; ++i) {
    const double turns = Draw(5, i, -3.0, 3.0);
    const long double exact = std::cos(2.0L * std::numbers::pi_v<long double> * turns);
    ASSERT_LE(std::abs(CosOfTurns(turns) - exact), 0x1p-52L) << turns;
  }
  EXPECT_EQ(CosOfTurns(0.0), 1.0);
  EXPECT_EQ(CosOfTurns(0.25), 0.0);
  EXPECT_EQ(CosOfTurns(0.5), -1.0);
  EXPECT_EQ(CosOfTurns(-1.0), 1.0);
}

TEST(PortableTest, HypotIsWithinTwoUnits) {
  for (int i = 0; i < kDraws; ++i) {
    const double x = std::ldexp(Draw(6, i, -1.0, 1.0), i % 2000 - 1000);
    const double y = x * std::ldexp(Draw(7, i, -1.0, 1.0), i % 60 - 30);
    if (std::isinf(y)) continue;
    const long double exact = std::hypot(static_cast<long double>(x), static_cast<long double>(y));
    ASSERT_LE(Error(Hypot(x, y), exact), 2.0) << x << ", " << y;
  }
  EXPECT_EQ(Hypot(0.0, 0.0), 0.0);
  EXPECT_EQ(Hypot(-3.0, 4.0), 5.0);
  EXPECT_EQ(Hypot(1.0, -kInfinity), kInfinity);
  EXPECT_TRUE(std::isnan(Hypot(std::numeric_limits<double>::quiet_NaN(), 1.0)));
}

TEST(PortableTest, LogNormalDistributionIsWithinItsBound) {
  for (int i = 0; i < kDraws; ++i) {
    const double z = i % 2 == 0 ? Draw(8, i, -100.0, 10.0) : Draw(9, i, -3.0, 3.0);
    const long double exact = std::log(0.5L * std::erfc(-z / std::numbers::sqrt2_v<long double>));
    ASSERT_LE(std::abs(LogNormalDistribution(z) - exact), 1e-13L * std::max(1.0L, -exact)) << z;
  }
  EXPECT_EQ(LogNormalDistribution(kInfinity), 0.0);
  EXPECT_EQ(LogNormalDistribution(-kInfinity), -kInfinity);
  // Below, erfc underflows even in extended precision: ln Phi(z) < -z^2/2.
  EXPECT_NEAR(LogNormalDistribution(-1e6), -0.5e12 - 13.8155 - 0.9189, 1e-3);
}

// FNV-1a over the bits of the results of a sweep. A processor, compiler or build type whose bits
// differ fails here.
TEST(PortableTest, BitsAreThoseOfEveryProcessor) {
  uint64_t hash = 14695981039346656037u;
  const auto add = [&hash](double value) {
    for (auto bits = std::bit_cast<uint64_t>(value), i = uint64_t{0}; i < 8; ++i, bits >>= 8) {
      hash = (hash ^ (bits & 0xff)) * 1099511628211u;
    }
  };
  for (int i = 0; i < kDraws; ++i) {
    add(Log(std::ldexp(Draw(1, i, 1.0, 2.0), i % 2000 - 1000)));
    add(Log(Draw(2, i, 0.7, 1.5)));
    add(Exp(Draw(3, i, -745.0, 709.0)));
    add(CosOfTurns(Draw(5, i, -3.0, 3.0)));
    add(Hypot(Draw(6, i, -1.0, 1.0), Draw(7, i, -1e3, 1e3)));
    add(LogNormalDistribution(Draw(8, i, -100.0, 10.0)));
    add(LogNormalDistribution(Draw(9, i, -3.0, 3.0)));
  }
  EXPECT_EQ(hash, 4680324265786491934u);
}

}  // namespace
}  // namespace spikeserve::portable
