#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <iostream>
#include <limits>
#include <string>

#include "core/learning/contribution_budget.h"
#include "core/learning/peer_norms.h"
#include "core/learning/return_guard.h"
#include "core/math/counter_random.h"

namespace spikeserve {
namespace {

using Budget = ContributionBudget;

// Returns how many of 1000 contributions are accepted.
int Accepted(Budget& budget, const std::string& contributor, absl::Duration now,
             bool is_protected = false) {
  int accepted = 0;
  for (int i = 0; i < 1000; ++i) accepted += budget.Take(contributor, now, is_protected) ? 1 : 0;
  return accepted;
}

TEST(ContributionBudgetTest, AMinuteIsBoundedForOneAndForAll) {
  Budget budget;
  EXPECT_EQ(Accepted(budget, "0", absl::Seconds(1)), Budget::kPerMinute);
  int together = Budget::kPerMinute;
  for (int i = 1; i < 20; ++i) together += Accepted(budget, std::to_string(i), absl::Seconds(1));
  EXPECT_EQ(together, Budget::kTotalPerMinute);
  EXPECT_EQ(Accepted(budget, "0", absl::Seconds(59)), 0);
  EXPECT_EQ(Accepted(budget, "0", absl::Seconds(100)), Budget::kPerMinute);
}

TEST(ContributionBudgetTest, AFullShareOfABadWindowSuspends) {
  Budget budget;
  constexpr bool kIsProtected = true;
  Accepted(budget, "0", {}, kIsProtected);
  EXPECT_TRUE(budget.Take("1", {}, kIsProtected));
  budget.OnWindowEnd(/*bad=*/true, kIsProtected);
  for (int window = 0; window < Budget::kSuspendedWindows; ++window) {
    EXPECT_TRUE(budget.IsSuspended("0")) << window;
    EXPECT_FALSE(budget.IsSuspended("1")) << window;
    EXPECT_TRUE(budget.Take("0", {}, kIsProtected))
        << window;  // its returns count, so that windows end
    budget.OnWindowEnd(/*bad=*/false, kIsProtected);
  }
  EXPECT_FALSE(budget.IsSuspended("0"));
}

constexpr double kNoLimit = std::numeric_limits<double>::infinity();

// Adds a contribution of each of the contributors "0", "1" and so on.
PeerNorms Norms(std::initializer_list<double> norms) {
  PeerNorms all;
  int i = 0;
  for (const double norm : norms) all.Add(std::to_string(i++), norm);
  return all;
}

TEST(PeerNormsTest, ThereIsNoLimitBeforeEnoughOthersHaveContributed) {
  const PeerNorms norms = Norms({0.1, 0.1, 0.1, 0.1});
  EXPECT_EQ(norms.Limit("0"), kNoLimit);  // of three others
  EXPECT_DOUBLE_EQ(norms.Limit("new"), 0.1 * PeerNorms::kFactor);
}

TEST(PeerNormsTest, TheLimitFollowsTheMedianOfTheOthers) {
  const PeerNorms norms = Norms({0.3, 0.1, 0.5, 0.2, 0.4});
  EXPECT_DOUBLE_EQ(norms.Limit("new"), 0.3 * PeerNorms::kFactor);
  EXPECT_DOUBLE_EQ(norms.Limit("2"), 0.2 * PeerNorms::kFactor);  // the lower of 0.2 and 0.3
}

TEST(PeerNormsTest, OneContributorCannotRaiseALimit) {
  PeerNorms norms = Norms({0.1, 0.1, 0.1, 0.1, 0.1});
  for (int i = 0; i < 1000; ++i) norms.Add("0", 1e6);
  EXPECT_DOUBLE_EQ(norms.Limit("0"), 0.1 * PeerNorms::kFactor);
  EXPECT_DOUBLE_EQ(norms.Limit("1"), 0.1 * PeerNorms::kFactor);
}

TEST(PeerNormsTest, TheLimitFollowsContributorsThatLearnFaster) {
  PeerNorms norms = Norms({0.1, 0.1, 0.1, 0.1, 0.1});
  for (int i = 0; i < 3; ++i) norms.Add(std::to_string(i), 10.0);
  EXPECT_DOUBLE_EQ(norms.Limit("4"), 10.0 * PeerNorms::kFactor);
}

TEST(PeerNormsTest, AContributionOfZeroSaysNothing) {
  PeerNorms norms = Norms({0.1, 0.1, 0.1, 0.1});
  for (int i = 0; i < 4; ++i) norms.Add(std::to_string(i), 0.0);
  EXPECT_DOUBLE_EQ(norms.Limit("new"), 0.1 * PeerNorms::kFactor);
}

TEST(PeerNormsTest, OnlyTheLastContributorsCount) {
  PeerNorms norms;
  for (size_t i = 0; i < 10 * PeerNorms::kContributors; ++i) norms.Add(std::to_string(i), 1.0);
  EXPECT_EQ(norms.norms.size(), PeerNorms::kContributors);
}

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
  EXPECT_FALSE(Window(197, 3));  // began at 2, which has earned 200 before it and 197 after it
  EXPECT_TRUE(Window(190, 4));
  EXPECT_EQ(delta_, Eigen::VectorXf::Constant(2, 2));
  EXPECT_EQ(guard_.rollbacks, 1);
  EXPECT_TRUE(guard_.on_probation);
  EXPECT_FALSE(Window(200, 2));
  EXPECT_FALSE(guard_.on_probation);
}

TEST_F(ReturnGuardTest, AHeadThatWasRestoredIsMeasuredAndNotGivenUp) {
  EXPECT_FALSE(Window(-100, 1));
  EXPECT_FALSE(Window(-100, 2));
  EXPECT_TRUE(Window(-150, 3));
  EXPECT_EQ(delta_, Eigen::VectorXf::Constant(2, 1));
  EXPECT_FALSE(Window(-150, 1));  // the environment has changed: the new reference
  EXPECT_FALSE(Window(-150, 2));
  EXPECT_EQ(guard_.rollbacks, 1);
  EXPECT_TRUE(Window(-200, 3));
}

// What a fleet has learned is not measured by its luckiest window, and never given up for the
// policy's own head, which is known to earn less.
TEST_F(ReturnGuardTest, TwoUnluckyWindowsGoBackOneStep) {
  EXPECT_FALSE(Window(12, 1));
  EXPECT_FALSE(Window(170, 2));
  EXPECT_FALSE(Window(300, 3));
  EXPECT_FALSE(Window(400, 4));
  for (int i = 0; i < 2; ++i) {
    EXPECT_TRUE(Window(200, 5));
    EXPECT_EQ(delta_, Eigen::VectorXf::Constant(2, 3));
    EXPECT_FALSE(Window(350, 3));
  }
}

// A held-out guard cannot keep others from contributing while it measures.
TEST_F(ReturnGuardTest, AHeadThatChangedWhileItWasMeasuredIsRestoredAgain) {
  EXPECT_FALSE(Window(100, 1));
  EXPECT_FALSE(Window(100, 2));
  EXPECT_TRUE(Window(10, 3));
  EXPECT_TRUE(Window(10, 3));
  EXPECT_EQ(delta_, Eigen::VectorXf::Constant(2, 1));
  EXPECT_EQ(guard_.reference.mean, 55.0);
}

TEST_F(ReturnGuardTest, NoiseIsForgiven) {
  for (int i = 0; i < 200; ++i) {
    delta_.setOnes();
    const double noise = UniformDouble(RandomBits({static_cast<uint64_t>(i)}));
    EXPECT_FALSE(guard_.OnEpisode(100 + 50 * noise, kMargin, &delta_)) << i;
  }
}

// A head that operators teach.
class TaughtGuardTest : public ReturnGuardTest {
 protected:
  void Teach(float delta) {
    guard_.OnTaught(delta_);
    delta_.setConstant(delta);
  }
  // Plays `episodes` without an operator, which all return `level`. Returns the head after them.
  float Alone(size_t episodes, double level) {
    for (size_t i = 0; i < episodes; ++i) guard_.OnEpisodeAlone(level, kMargin, &delta_);
    return delta_[0];
  }
};

TEST_F(TaughtGuardTest, AnOperatorWhoSpoilsTheHeadLosesItSoonAfterHeHasLeft) {
  Alone(ReturnGuard::kAlone, 200);
  Teach(1);
  Teach(2);
  EXPECT_EQ(Alone(ReturnGuard::kAlone - 1, 20), 2);
  EXPECT_EQ(Alone(1, 20), 0);
  EXPECT_EQ(Alone(ReturnGuard::kWindow, 199), 0);
  EXPECT_EQ(guard_.rollbacks, 1);
}

TEST_F(TaughtGuardTest, AMotorThatFailedMeanwhileIsNotHeldAgainstTheOperator) {
  Alone(ReturnGuard::kAlone, 200);
  Teach(1);
  EXPECT_EQ(Alone(ReturnGuard::kAlone, 150), 0);
  EXPECT_EQ(Alone(ReturnGuard::kAlone, 10), 1);
  EXPECT_EQ(guard_.rollbacks, 2);
  Teach(2);
  EXPECT_EQ(Alone(ReturnGuard::kAlone, 10), 1);  // which earned 150
}

TEST_F(TaughtGuardTest, AHeadThatIsTaughtALittleNowAndThenIsJudged) {
  Alone(ReturnGuard::kAlone, 200);
  for (size_t i = 0; i < ReturnGuard::kAlone; ++i) {
    EXPECT_EQ(guard_.rollbacks, 0);
    Teach(1 + static_cast<float>(i));
    Alone(1, 20);
  }
  EXPECT_EQ(delta_[0], 0);
}

TEST_F(TaughtGuardTest, WhatEarnsMoreIsWhatAWorseHeadGoesBackTo) {
  Alone(ReturnGuard::kAlone - 1, 500);  // too few to be a level
  Teach(1);
  EXPECT_EQ(Alone(ReturnGuard::kWindow, 30), 1);
  Teach(2);
  EXPECT_EQ(Alone(ReturnGuard::kAlone, 90), 2);
  Teach(3);
  EXPECT_EQ(Alone(ReturnGuard::kAlone, 60), 2);
}

// Honest fleets: 100 seeds of 30 rounds of 16 episodes, whose returns are spread as those of a pole
// that balances ever longer, from 12 to 300 steps: exponentially, and at most 500.
TEST(FalseAlarmTest, HonestFleetsAreRarelySetBack) {
  constexpr int kSeeds = 100;
  constexpr int kEpisodes = 30 * 16;
  int alarms = 0;
  int windows = 0;
  for (uint64_t seed = 0; seed < kSeeds; ++seed) {
    Eigen::VectorXf delta = Eigen::VectorXf::Zero(1);
    ReturnGuard guard = ReturnGuard::New(delta);
    float learned = 0.0f;  // rounds of learning in the head
    for (int episode = 0; episode < kEpisodes; ++episode) {
      const double level = 12.0 + 288.0 * std::min(1.0, static_cast<double>(delta[0]) / 15.0);
      const double uniform = UniformDouble(RandomBits({seed, static_cast<uint64_t>(episode)}));
      const double episode_return = std::min(500.0, -level * std::log(1.0 - uniform));
      if (!guard.on_probation) delta[0] += 1.0f / 16.0f;
      alarms += guard.OnEpisode(episode_return, kMargin, &delta) ? 1 : 0;
      learned = delta[0];
    }
    windows += kEpisodes / static_cast<int>(ReturnGuard::kWindow);
    EXPECT_GT(learned, 7.5f) << "seed " << seed;
  }
  const double rate = static_cast<double>(alarms) / windows;
  std::cout << "false alarms: " << alarms << " of " << windows << " windows, " << 100.0 * rate
            << " %\n";
  EXPECT_LT(rate, 0.01);
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
