#include "core/environment/numpy_random.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <array>
#include <cstdint>
#include <numbers>
#include <random>

namespace spikeserve {
namespace {

using std::numbers::pi;
using ::testing::ElementsAre;

std::array<uint64_t, 3> RawBits(uint64_t seed) {
  NumpyRandom random(seed);
  return {random(), random(), random()};
}

std::array<double, 3> Uniforms(uint64_t seed, double low, double high) {
  NumpyRandom random(seed);
  return {random.Uniform(low, high), random.Uniform(low, high), random.Uniform(low, high)};
}

// for s in (0, 7, 2**32 - 1, 2**32, 2**64 - 1):
//   print([f"{x:#018x}" for x in numpy.random.PCG64(s).random_raw(3)])
TEST(NumpyRandomTest, RawBitsAreThoseOfPcg64) {
  EXPECT_THAT(RawBits(0), ElementsAre(0xa30febcfd9c2825f, 0x4510bdf882d9d721, 0x0a7d3da94ecde8b8));
  EXPECT_THAT(RawBits(7), ElementsAre(0xa00641a9f1e54a8b, 0xe5afcdbcaf266a95, 0xc693565f940af962));
  EXPECT_THAT(RawBits(0xffffffff),
              ElementsAre(0x407f5fa930d8fd9f, 0x3814b22eb9684802, 0x498b7dcee8d8dc95));
  EXPECT_THAT(RawBits(0x100000000),
              ElementsAre(0xe3c5ebe285ac1625, 0x8ea09968fe31dbcc, 0xcd084ff84d8de9be));
  EXPECT_THAT(RawBits(0xffffffffffffffff),
              ElementsAre(0xae163a7a8c47568f, 0xd86659f5f3382359, 0x01e52b195bc2d24a));
}

// for s in (0, 123456789, 2**63 + 5):
//   print([x.hex() for x in numpy.random.default_rng(s).uniform(-0.05, 0.05, 3).tolist()])
TEST(NumpyRandomTest, UniformIsThatOfGenerator) {
  EXPECT_THAT(Uniforms(0, -0.05, 0.05),
              ElementsAre(0x1.c0cbca647ced0p-7, -0x1.792e736320f47p-6, -0x1.7808d4489d6d2p-5));
  EXPECT_THAT(Uniforms(123456789, -0.05, 0.05),
              ElementsAre(-0x1.82e5d13d1de9dp-5, 0x1.4d2b2ef845d8ep-5, 0x1.3870068de3c66p-5));
  EXPECT_THAT(Uniforms(0x8000000000000005, -0.05, 0.05),
              ElementsAre(-0x1.0316b13c695a0p-9, 0x1.4b194cf3cd26ep-5, 0x1.d06c45ddd0d68p-7));
}

// [x.hex() for x in numpy.random.default_rng(1).uniform(-numpy.pi, numpy.pi, 3).tolist()]
TEST(NumpyRandomTest, UniformRoundsWideRangesAlike) {
  EXPECT_THAT(Uniforms(1, -pi, pi),
              ElementsAre(0x1.303d8f79e5900p-4, 0x1.6a48ce770b50cp+1, -0x1.1e2f0ed25d9e8p+1));
}

TEST(NumpyRandomTest, CopyForksTheStream) {
  NumpyRandom random(3);
  random();
  NumpyRandom fork = random;
  EXPECT_EQ(random(), fork());
}

TEST(NumpyRandomTest, ServesStandardDistributions) {
  static_assert(std::uniform_random_bit_generator<NumpyRandom>);
  NumpyRandom random(3);
  std::uniform_int_distribution<int> die(1, 6);
  for (int i = 0; i < 100; ++i)
    EXPECT_THAT(die(random), ::testing::AllOf(testing::Ge(1), testing::Le(6)));
}

}  // namespace
}  // namespace spikeserve
