// The parts of the robot's end of a session: the fallback order, the log of steps, the ages.
#include <array>
#include <chrono>
#include <cmath>
#include <vector>

#include "core/robot/counters.h"
#include "core/robot/fallback_order.h"
#include "core/robot/observation.h"
#include "core/robot/step_log.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace spikeserve::robot {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using ::testing::ElementsAre;

ActionShape Box() { return ActionShape(0, {-2.0f, -1.0f}, {2.0f, 1.0f}); }

ActionValue Values(float first, float second) { return {0, {first, second}}; }

TEST(FallbackOrderTest, TheSourcesFollowEachOther) {
  FallbackOrder fallback(Box(), Values(0, 0), /*hold_steps=*/2, /*oldest_held=*/seconds(1),
                         /*ramp_steps=*/4, Time::zero());
  const Time now = seconds(8);
  EXPECT_FALSE(fallback.Hold(now));  // there is nothing to hold
  EXPECT_FALSE(fallback.Ramp());
  fallback.TakeSafe(fallback.neutral().view());
  const ActionValue answer = Values(1, 1);
  fallback.TakeFresh(answer.view(), seconds(7));
  EXPECT_TRUE(fallback.Hold(now) && fallback.Hold(now));
  EXPECT_FALSE(fallback.Hold(now));
  EXPECT_THAT(fallback.action().continuous, ElementsAre(1.0f, 1.0f));
  EXPECT_EQ(fallback.observed_at(), seconds(7));
  const ActionValue own = Values(0.5f, -0.5f);
  fallback.TakeLocal(own.view(), seconds(9));
  EXPECT_FALSE(fallback.Hold(now));
  EXPECT_TRUE(fallback.Ramp());
  EXPECT_THAT(fallback.action().continuous, ElementsAre(0.375f, -0.375f));
  EXPECT_TRUE(fallback.Ramp() && fallback.Ramp() && fallback.Ramp());
  EXPECT_THAT(fallback.action().continuous, ElementsAre(0.0f, 0.0f));
  EXPECT_FALSE(fallback.Ramp());
  EXPECT_EQ(fallback.entries(), (BySource{1, 1, 1, 2}));
}

TEST(FallbackOrderTest, NothingIsHeldOverTheEndOfAnEpisode) {
  FallbackOrder fallback(Box(), Values(0, 0), 3, seconds(1), 4, Time::zero());
  const ActionValue answer = Values(1, 1);
  fallback.TakeFresh(answer.view(), Time::zero());
  fallback.BeginEpisode();
  EXPECT_FALSE(fallback.Hold(Time::zero()));
}

TEST(FallbackOrderTest, ChangesAreToldOnceAndOnlyThoseThatMatter) {
  FallbackOrder fallback(Box(), Values(0, 0), 1, seconds(1), 0, Time::zero());
  const ActionValue answer = Values(1, 1);
  for (int i = 0; i < 3; ++i) {
    fallback.TakeFresh(answer.view(), Time::zero());
    fallback.Hold(Time::zero());
  }
  EXPECT_FALSE(fallback.has_change());
  fallback.TakeSafe(answer.view());
  fallback.TakeSafe(answer.view());
  const auto change = fallback.TakeChange();
  EXPECT_EQ(change->to, Source::kSafe);
  EXPECT_EQ(change->steps, 1);
  EXPECT_FALSE(fallback.TakeChange().has_value());
}

// Adds steps to a log, and does with its requests what the server does.
class Robot {
 public:
  explicit Robot(size_t kept) : log(kept, 1, Box()) { log.set_history_limit(100); }

  void Step(bool sees = true) {
    const float number = static_cast<float>(steps_++);
    log.Add({&number, sees ? 1u : 0u}, number, Time(steps_));
    log.SetExecuted(Values(number, number).view());
  }

  // Sends the request of the oldest episode. Returns whether it asks for a decision.
  bool Ask() {
    const Request request = log.NextRequest();
    const Episode& episode = *request.episode;
    const uint64_t known = episode.first + session.size();
    EXPECT_LE(request.skipped, known);
    // Of a stored session, what was executed before the expected step may be lost.
    if (!session.empty() && request.end > known && request.skipped == request.begin) {
      EXPECT_LT(request.begin, known);
    }
    for (uint64_t number = known; number < request.begin; ++number) {
      session.push_back(NAN);  // of which only the reward is known
      rewards += log.RewardOf(number);
    }
    for (uint64_t number = std::max(request.begin, known); number < request.end; ++number) {
      Append(log.StepOf(episode, number));
    }
    if (request.asks) Append(log.At(request.end));
    log.Acknowledge(static_cast<int64_t>(session.size()));
    return request.asks;
  }

  StepLog log;
  std::vector<float> session;  // observations of the running episode at the server
  double rewards = 0.0;

 private:
  void Append(const StepView& step) {
    EXPECT_EQ(step.executed.continuous.size(), 2);
    session.push_back(step.observation.empty() ? NAN : step.observation[0]);
    rewards += step.reward;
  }

  int64_t steps_ = 0;
};

TEST(StepLogTest, TheNextEpisodeIsAskedForWhileTheEndIsUnderWay) {
  Robot robot(100);
  for (int i = 0; i < 3; ++i) robot.Step();
  robot.log.End({.reward = 1.0});
  EXPECT_TRUE(robot.log.FitsOne());
  robot.Step();
  EXPECT_TRUE(robot.log.is_one_behind());
  robot.log.BeginEnd();
  EXPECT_TRUE(robot.log.is_current());
  const Request request = robot.log.NextRequest();
  EXPECT_EQ(request.step(), 0);
  EXPECT_EQ(request.decision, 3);
  EXPECT_EQ(request.end - request.skipped, 0);
  robot.log.End({.reward = 1.0});
  robot.Step();
  EXPECT_FALSE(robot.log.is_current());  // two ends are never under way
  robot.log.Settle(/*is_stored=*/false);
  EXPECT_FALSE(robot.log.is_ending() || robot.log.is_current());
  robot.log.Acknowledge(1);
  EXPECT_TRUE(robot.log.is_complete());
}

TEST(StepLogTest, MoreBlindStepsThanAHistoryHasCountAsRewards) {
  Robot robot(1000);
  robot.log.set_history_limit(10);
  robot.Step();
  EXPECT_TRUE(robot.Ask());
  for (int i = 0; i < 50; ++i) robot.Step(/*sees=*/false);
  robot.Step();
  EXPECT_TRUE(robot.Ask());
  EXPECT_EQ(robot.session.size(), 52);
  EXPECT_TRUE(std::isnan(robot.session[50]));
  EXPECT_EQ(robot.session[51], 51.0f);
  for (int i = 0; i < 50; ++i) robot.Step(/*sees=*/false);
  robot.log.End({.reward = 1.0});
  EXPECT_FALSE(robot.Ask());
  EXPECT_EQ(robot.session.size(), 102);
  EXPECT_EQ(robot.rewards, 101.0 * 102.0 / 2.0);
}

// Plays an episode that the server answers wholly.
void EndAndSettle(int steps, Robot* robot, bool is_stored) {
  for (int i = 0; i < steps; ++i) robot->Step();
  robot->log.End({.reward = 1.0});
  robot->Ask();
  robot->session.clear();
  robot->log.Settle(is_stored);
}

TEST(StepLogTest, TheEndOfAnEpisodeIsKeptUntilTheStoreHasIt) {
  Robot robot(100);
  for (const int steps : {3, 2, 4}) EndAndSettle(steps, &robot, /*is_stored=*/true);
  robot.Step();
  EXPECT_TRUE(robot.Ask());
  robot.log.ForgetDurable(/*decisions=*/3, /*episodes=*/1);
  robot.log.ForgetDurable(6, 0);  // an older server: a decision behind the second end
  EXPECT_FALSE(robot.log.Rewind(4, 1));
  // The server has lost the last end, and two steps before it.
  EXPECT_TRUE(robot.log.Rewind(7, 2));
  EXPECT_EQ(robot.log.oldest().index, 2);
  robot.session = {5, 6};
  EXPECT_FALSE(robot.Ask());
  EXPECT_THAT(robot.session, ElementsAre(5, 6, 7, 8));
  EXPECT_TRUE(robot.log.is_complete());
  EXPECT_EQ(robot.log.oldest().steps, 4);
  robot.log.Settle(true);
  robot.session.clear();
  EXPECT_TRUE(robot.Ask());
  EXPECT_THAT(robot.session, ElementsAre(9));
  // It has lost the end alone: the decision that it expects is the same.
  EXPECT_TRUE(robot.log.Rewind(9, 2));
  EXPECT_EQ(robot.log.oldest().index, 2);
  EXPECT_TRUE(robot.log.is_complete());
}

TEST(StepLogTest, ASessionThatNoStoreHasKeepsNoEndedEpisode) {
  Robot robot(100);
  EndAndSettle(3, &robot, /*is_stored=*/false);
  robot.Step();
  EXPECT_FALSE(robot.log.Rewind(2, 0));
}

TEST(ObservationTest, AnObservationHasItsSizeAndFiniteNumbers) {
  InvalidObservation why;
  std::array<float, 2> two = {1.0f, 2.0f};
  EXPECT_TRUE(IsObservation(two, 2, &why));
  EXPECT_FALSE(IsObservation(std::span(two).first(1), 2, &why));
  EXPECT_EQ(why.ToString(), "observation: expected 2 numbers, received 1");
  two[1] = NAN;
  EXPECT_FALSE(IsObservation(two, 2, &why));
  EXPECT_EQ(why.ToString(), "observation[1]: expected a finite number, received nan");
}

TEST(AgesTest, PercentilesAreExactToTwoPercent) {
  Ages ages;
  EXPECT_EQ(ages.Quantile(0.5), Time::zero());
  for (int i = 1; i <= 1000; ++i) ages.Add(milliseconds(i));
  for (const double share : {0.5, 0.99, 0.999}) {
    EXPECT_NEAR(std::chrono::duration<double>(ages.Quantile(share)).count(), share, 0.02 * share);
  }
  ages.Add(std::chrono::hours(1000));
  EXPECT_GT(ages.Quantile(1.0), seconds(3000));
}

}  // namespace
}  // namespace spikeserve::robot
