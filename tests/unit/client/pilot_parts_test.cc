// The parts of a pilot that wait for nothing: the ladder, the log of beats, the ages.
#include <cmath>
#include <vector>

#include "client/src/pilot/beat_log.h"
#include "client/src/pilot/counters.h"
#include "client/src/pilot/ladder.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace spikeserve::piloting {
namespace {

using ::testing::ElementsAre;

ActionShape Box() {
  v1::ActionSpace space;
  for (const float bound : {2.0f, 1.0f}) {
    space.mutable_box()->add_low(-bound);
    space.mutable_box()->add_high(bound);
  }
  return ActionShape(space);
}

ActionValue Values(float first, float second) { return {0, {first, second}}; }

TEST(LadderTest, TheRungsFollowEachOther) {
  Ladder ladder(Box(), Values(0, 0), /*hold_beats=*/2, /*ramp_beats=*/4, absl::ZeroDuration());
  EXPECT_FALSE(ladder.Hold());  // there is nothing to hold
  EXPECT_FALSE(ladder.Ramp());
  ladder.TakeSafe(ladder.neutral().view());
  const ActionValue answer = Values(1, 1);
  ladder.TakeFresh(answer.view(), absl::Seconds(7));
  EXPECT_TRUE(ladder.Hold() && ladder.Hold());
  EXPECT_FALSE(ladder.Hold());
  EXPECT_THAT(ladder.action().continuous, ElementsAre(1.0f, 1.0f));
  EXPECT_EQ(ladder.observed_at(), absl::Seconds(7));
  const ActionValue own = Values(0.5f, -0.5f);
  ladder.TakeLocal(own.view(), absl::Seconds(9));
  EXPECT_FALSE(ladder.Hold());
  EXPECT_TRUE(ladder.Ramp());
  EXPECT_THAT(ladder.action().continuous, ElementsAre(0.375f, -0.375f));
  EXPECT_TRUE(ladder.Ramp() && ladder.Ramp() && ladder.Ramp());
  EXPECT_THAT(ladder.action().continuous, ElementsAre(0.0f, 0.0f));
  EXPECT_FALSE(ladder.Ramp());
  EXPECT_EQ(ladder.entries(), (PilotStats::BySource{1, 1, 1, 2}));
}

TEST(LadderTest, NothingIsHeldOverTheEndOfAnEpisode) {
  Ladder ladder(Box(), Values(0, 0), 3, 4, absl::ZeroDuration());
  const ActionValue answer = Values(1, 1);
  ladder.TakeFresh(answer.view(), absl::ZeroDuration());
  ladder.BeginEpisode();
  EXPECT_FALSE(ladder.Hold());
}

TEST(LadderTest, ChangesAreToldOnceAndOnlyThoseThatMatter) {
  Ladder ladder(Box(), Values(0, 0), 1, 0, absl::ZeroDuration());
  const ActionValue answer = Values(1, 1);
  for (int i = 0; i < 3; ++i) {
    ladder.TakeFresh(answer.view(), absl::ZeroDuration());
    ladder.Hold();
  }
  EXPECT_FALSE(ladder.has_change());
  ladder.TakeSafe(answer.view());
  ladder.TakeSafe(answer.view());
  const auto change = ladder.TakeChange();
  EXPECT_EQ(change->to, ActionSource::kSafe);
  EXPECT_EQ(change->beats, 1);
  EXPECT_FALSE(ladder.TakeChange().has_value());
}

// Adds beats to a log, and does with its requests what the server does.
class Robot {
 public:
  explicit Robot(size_t kept) : log(kept, 1, Box()) { log.set_history_limit(100); }

  void Beat() {
    const float number = static_cast<float>(beats_++);
    log.Add({&number, 1}, number, beats_);
    log.SetExecuted(Values(number, number).view());
  }

  // Sends the request of the oldest episode. Returns whether it asks for a decision.
  bool Ask() {
    v1::ActRequest request;
    log.FillRequest(&request);
    const int64_t begin = request.step() - request.history_size();
    const auto known = static_cast<int64_t>(session.size());
    EXPECT_LE(begin - request.skipped_rewards_size(), known);
    for (int64_t step = known; step < begin; ++step) {
      session.push_back(NAN);  // of which only the reward is known
      const auto i = static_cast<int>(step - begin + request.skipped_rewards_size());
      rewards += request.skipped_rewards(i);
    }
    for (const v1::Beat& beat : request.history()) {
      EXPECT_TRUE(beat.has_executed());
      if (beat.step() < static_cast<int64_t>(session.size())) continue;
      EXPECT_EQ(beat.step(), static_cast<int64_t>(session.size()));
      session.push_back(beat.observation(0));
      rewards += beat.reward();
    }
    const bool asks = request.observation_size() > 0;
    if (asks) {
      session.push_back(request.observation(0));
      rewards += request.reward();
    }
    log.Acknowledge(static_cast<int64_t>(session.size()));
    return asks;
  }

  BeatLog log;
  std::vector<float> session;  // observations of the running episode at the server
  double rewards = 0.0;

 private:
  int64_t beats_ = 0;
};

TEST(BeatLogTest, EveryBeatTravelsOnce) {
  Robot robot(100);
  for (const bool asks : {true, false, false, true, false, true}) {
    robot.Beat();
    if (asks) {
      EXPECT_TRUE(robot.Ask());
    }
  }
  robot.Beat();
  robot.Beat();
  auto summary = robot.log.End({.reward = 1.0});
  EXPECT_FALSE(robot.log.is_complete());
  EXPECT_FALSE(robot.Ask());
  EXPECT_TRUE(robot.log.is_complete());
  EXPECT_THAT(robot.session, ElementsAre(0, 1, 2, 3, 4, 5, 6, 7));
  v1::EndEpisodeRequest end;
  robot.log.FillEnd(&end);
  EXPECT_EQ(end.steps(), 8);
  EXPECT_EQ(end.executed_action().continuous().values(0), 7.0f);
  robot.log.Settle().summary.set_value(v1::EndEpisodeResponse());
  EXPECT_TRUE(summary.get().ok());
  EXPECT_TRUE(robot.log.is_current());
  EXPECT_EQ(robot.log.running().index, 1);
  EXPECT_EQ(robot.log.running().first, 8);
}

TEST(BeatLogTest, TheNextEpisodeIsAskedForWhileTheEndIsUnderWay) {
  Robot robot(100);
  for (int i = 0; i < 3; ++i) robot.Beat();
  robot.log.End({.reward = 1.0});
  EXPECT_TRUE(robot.log.FitsOne());
  robot.Beat();
  EXPECT_TRUE(robot.log.is_one_behind());
  robot.log.BeginEnd();
  EXPECT_TRUE(robot.log.is_current());
  v1::ActRequest request;
  robot.log.FillRequest(&request);
  EXPECT_EQ(request.step(), 0);
  EXPECT_EQ(request.decision(), 3);
  EXPECT_EQ(request.history_size() + request.skipped_rewards_size(), 0);
  robot.log.End({.reward = 1.0});
  robot.Beat();
  EXPECT_FALSE(robot.log.is_current());  // two ends are never under way
  robot.log.Settle();
  EXPECT_FALSE(robot.log.is_ending() || robot.log.is_current());
  robot.log.Acknowledge(1);
  EXPECT_TRUE(robot.log.is_complete());
}

TEST(BeatLogTest, ALongHistoryTravelsInParts) {
  Robot robot(1000);
  for (int i = 0; i < 250; ++i) robot.Beat();
  EXPECT_FALSE(robot.Ask());
  EXPECT_FALSE(robot.Ask());
  EXPECT_TRUE(robot.Ask());
  for (size_t i = 0; i < 250; ++i) EXPECT_EQ(robot.session[i], static_cast<float>(i));
}

TEST(BeatLogTest, OfBeatsThatAreNotKeptTheRewardsTravel) {
  Robot robot(10);
  for (int i = 0; i < 30; ++i) robot.Beat();
  EXPECT_EQ(robot.log.dropped(), 20);
  EXPECT_TRUE(robot.Ask());
  EXPECT_EQ(robot.rewards, 435.0);
  EXPECT_TRUE(std::isnan(robot.session[19]));
  EXPECT_EQ(robot.session[20], 20.0f);
}

TEST(BeatLogTest, TheLastBeatOfAnEpisodeOutlastsTheRing) {
  Robot robot(4);
  robot.Beat();
  robot.Beat();
  robot.log.End({.reward = 1.0});
  for (int i = 0; i < 10; ++i) robot.Beat();
  EXPECT_FALSE(robot.Ask());
  EXPECT_TRUE(robot.log.is_complete());
  EXPECT_EQ(robot.rewards, 1.0);
  EXPECT_EQ(robot.session[1], 1.0f);
}

TEST(BeatLogTest, AServerThatLostBeatsGetsThemAgain) {
  Robot robot(100);
  for (int i = 0; i < 20; ++i) {
    robot.Beat();
    robot.Ask();
  }
  robot.session.resize(16);
  EXPECT_TRUE(robot.log.Rewind(16));
  robot.Beat();
  EXPECT_TRUE(robot.Ask());
  EXPECT_EQ(robot.session.size(), 21);
  EXPECT_FALSE(robot.log.Rewind(22));
}

TEST(BeatLogTest, ANewSessionGoesOnWithTheBeatsThatAreKept) {
  Robot robot(100);
  robot.Beat();
  robot.log.End({.reward = 1.0});
  for (int i = 0; i < 5; ++i) robot.Beat();
  EXPECT_EQ(robot.log.BeginAgain().size(), 1);
  EXPECT_TRUE(robot.Ask());
  EXPECT_THAT(robot.session, ElementsAre(1, 2, 3, 4, 5));
  EXPECT_EQ(robot.log.lost_episodes(), 1);
  EXPECT_EQ(robot.log.running().index, 0);
}

TEST(BeatLogTest, ManyEpisodesWithoutTheServerAreTooLong) {
  Robot robot(100);
  while (!robot.log.is_too_long()) {
    robot.Beat();
    robot.log.End({.reward = 1.0});
  }
  EXPECT_EQ(robot.log.BeginAgain().size(), 64);
  EXPECT_FALSE(robot.log.is_too_long());
}

TEST(AgesTest, PercentilesAreExactToTwoPercent) {
  Ages ages;
  EXPECT_EQ(ages.Quantile(0.5), absl::ZeroDuration());
  for (int i = 1; i <= 1000; ++i) ages.Add(absl::Milliseconds(i));
  for (const double share : {0.5, 0.99, 0.999}) {
    EXPECT_NEAR(absl::ToDoubleSeconds(ages.Quantile(share)), share, 0.02 * share);
  }
  ages.Add(absl::Hours(1000));
  EXPECT_GT(ages.Quantile(1.0), absl::Seconds(3000));
}

}  // namespace
}  // namespace spikeserve::piloting
