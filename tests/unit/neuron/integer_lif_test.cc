#include "core/neuron/integer_lif.h"

#include <gtest/gtest.h>

#include <cmath>

namespace spikeserve {
namespace {

constexpr int16_t kNever = 32767;  // a threshold that the membranes below do not reach

// Returns the membrane after one tick without current.
int16_t Leak(int16_t decay, int16_t membrane) {
  IntegerLif{decay}.Step(0, kNever, membrane);
  return membrane;
}

TEST(IntegerLifTest, LeaksFiresAtThresholdAndResetsHard) {
  const IntegerLif lif = {16384};  // one half
  int16_t membrane = 0;
  EXPECT_FALSE(lif.Step(75, 100, membrane));
  EXPECT_EQ(membrane, 75);
  EXPECT_FALSE(lif.Step(0, 100, membrane));
  EXPECT_EQ(membrane, 38) << "37.5 rounds up";
  EXPECT_TRUE(lif.Step(81, 100, membrane)) << "the membrane equals the threshold";
  EXPECT_EQ(membrane, 0);
  EXPECT_TRUE(lif.Step(1, 1, membrane));
}

TEST(IntegerLifTest, RoundsHalfUpForBothSigns) {
  EXPECT_EQ(Leak(16384, 1), 1);    // 0.5
  EXPECT_EQ(Leak(16384, -1), 0);   // -0.5
  EXPECT_EQ(Leak(16384, 3), 2);    // 1.5
  EXPECT_EQ(Leak(16384, -3), -1);  // -1.5
  EXPECT_EQ(Leak(8192, -1), 0);    // -0.25
  EXPECT_EQ(Leak(24576, -1), -1);  // -0.75
}

TEST(IntegerLifTest, LeaksTheWholeRangeWithoutOverflow) {
  for (const int16_t decay : {0, 1, 16384, 31130, 32766, 32767}) {
    for (int membrane = -32768; membrane <= 32767; ++membrane) {
      if (membrane == kNever && decay == 32767) continue;
      const double exact = decay / 32768.0 * membrane;
      ASSERT_EQ(Leak(decay, static_cast<int16_t>(membrane)), std::floor(exact + 0.5))
          << decay << " x " << membrane;
    }
  }
}

TEST(IntegerLifTest, ClampsAtBothEnds) {
  const IntegerLif lif = {32767};
  int16_t membrane = -32768;
  EXPECT_FALSE(lif.Step(-32767, 1, membrane));
  EXPECT_EQ(membrane, -32768);
  membrane = -2;
  EXPECT_FALSE(lif.Step(-32767, 1, membrane));
  EXPECT_EQ(membrane, -32768) << "-2 - 32767 is one below the range";
  membrane = 32766;
  EXPECT_TRUE(lif.Step(32767, 32767, membrane)) << "the sum does not wrap to a negative number";
  membrane = 0;
  EXPECT_TRUE(lif.Step(32767, 32767, membrane));
  EXPECT_FALSE(lif.Step(32766, 32767, membrane));
  EXPECT_EQ(membrane, 32766);
}

}  // namespace
}  // namespace spikeserve
