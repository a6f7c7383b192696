#include "core/learning/return_guard.h"

#include <gtest/gtest.h>

#include <cmath>

#include "core/math/counter_random.h"

namespace spikeserve {
namespace {

constexpr double kMargin = 0.02;

class ReturnGuardTest : public ::testing::Test {
 protected:
  // Plays a window of episodes that all return `level`, on a head at `delta`. Returns whether the
  // guard rolled the head back at the end of the window; expects that it does not do so earlier.
  bool Window(double level, float delta) {
    delta_.setConstant(delta);
    bool rolled_back = false;
    for (size_t i = 0; i < ReturnGuard::kWindow; ++i) {
      EXPECT_FALSE(rolled_back);
      rolled_back = guard_.OnEpisode(level, kMargin, &delta_);
    }
    return rolled_back;
  }

  Eigen::VectorXf delta_ = Eigen::VectorXf::Zero(2);
  ReturnGuard guard_ = ReturnGuard::New(delta_);
};

TEST_F(ReturnGuardTest, ABadWindowBringsBackTheHeadThatTheLastGoodOneBeganWith) {
  EXPECT_FALSE(Window(100, 1));  // began at 0
  EXPECT_FALSE(Window(200, 2));  // began at 1
  EXPECT_FALSE(Window(197, 3));  // within the margin; began at 2
  EXPECT_TRUE(Window(195, 4));
  EXPECT_EQ(delta_, Eigen::VectorXf::Constant(2, 2));
  EXPECT_EQ(guard_.rollbacks, 1);
  EXPECT_FALSE(Window(200, 2));
  EXPECT_FALSE(guard_.on_probation);
}

TEST_F(ReturnGuardTest, ASecondBadWindowBringsBackThePolicysHeadAndMeasuresAnew) {
  EXPECT_FALSE(Window(-100, 1));
  EXPECT_FALSE(Window(-100, 2));
  EXPECT_TRUE(Window(-150, 3));
  EXPECT_EQ(delta_, Eigen::VectorXf::Constant(2, 1));
  EXPECT_TRUE(Window(-150, 1));
  EXPECT_EQ(delta_, Eigen::VectorXf::Zero(2));
  EXPECT_FALSE(Window(-150, 0));  // the new reference
  EXPECT_FALSE(Window(-150, 1));
  EXPECT_EQ(guard_.rollbacks, 2);
}

TEST_F(ReturnGuardTest, NoiseIsForgiven) {
  for (int i = 0; i < 200; ++i) {
    delta_.setOnes();
    const double noise = UniformDouble(RandomBits({static_cast<uint64_t>(i)}));
    EXPECT_FALSE(guard_.OnEpisode(100 + 50 * noise, kMargin, &delta_)) << i;
  }
}

TEST_F(ReturnGuardTest, AbsurdReturnsOfAFewMoveNothing) {
  for (int window = 0; window < 4; ++window) {
    for (int i = 0; i < 20; ++i) {
      const double absurd = i % 2 == 0 ? 1e30 : -1e30;
      EXPECT_FALSE(guard_.OnEpisode(i < 4 ? absurd : 100.0, kMargin, &delta_));
    }
    EXPECT_EQ(guard_.reference.mean, 100.0);
  }
  EXPECT_TRUE(Window(50, 1));
}

TEST(InterquartileMeanTest, IsTheMeanOfTheMiddleHalf) {
  const WindowLevel level = InterquartileMean({9, 1, 2, 3, 4, 5, 6, -7});
  EXPECT_DOUBLE_EQ(level.mean, 3.5);  // 2, 3, 4, 5
  // The winsorised values are 2 2 2 3 4 5 5 5, with deviation sqrt(14 / 7). Half of the 8 are kept.
  EXPECT_DOUBLE_EQ(level.error, std::sqrt(14.0 / 7.0) / (0.5 * std::sqrt(8.0)));
}

}  // namespace
}  // namespace spikeserve
