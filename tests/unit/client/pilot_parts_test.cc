// The parts of a pilot that wait for nothing: the fallback order, the log of beats, the ages.
#include <cmath>
#include <vector>

#include "client/src/pilot/beat_log.h"
#include "client/src/pilot/counters.h"
#include "client/src/pilot/fallback_order.h"
#include "client/src/pilot/sight.h"
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

TEST(FallbackOrderTest, TheSourcesFollowEachOther) {
  FallbackOrder fallback(Box(), Values(0, 0), /*hold_beats=*/2, /*oldest_held=*/absl::Seconds(1),
                         /*ramp_beats=*/4, absl::ZeroDuration());
  const absl::Duration now = absl::Seconds(8);
  EXPECT_FALSE(fallback.Hold(now));  // there is nothing to hold
  EXPECT_FALSE(fallback.Ramp());
  fallback.TakeSafe(fallback.neutral().view());
  const ActionValue answer = Values(1, 1);
  fallback.TakeFresh(answer.view(), absl::Seconds(7));
  EXPECT_TRUE(fallback.Hold(now) && fallback.Hold(now));
  EXPECT_FALSE(fallback.Hold(now));
  EXPECT_THAT(fallback.action().continuous, ElementsAre(1.0f, 1.0f));
  EXPECT_EQ(fallback.observed_at(), absl::Seconds(7));
  const ActionValue own = Values(0.5f, -0.5f);
  fallback.TakeLocal(own.view(), absl::Seconds(9));
  EXPECT_FALSE(fallback.Hold(now));
  EXPECT_TRUE(fallback.Ramp());
  EXPECT_THAT(fallback.action().continuous, ElementsAre(0.375f, -0.375f));
  EXPECT_TRUE(fallback.Ramp() && fallback.Ramp() && fallback.Ramp());
  EXPECT_THAT(fallback.action().continuous, ElementsAre(0.0f, 0.0f));
  EXPECT_FALSE(fallback.Ramp());
  EXPECT_EQ(fallback.entries(), (PilotStats::BySource{1, 1, 1, 2}));
}

TEST(FallbackOrderTest, NothingIsHeldOverTheEndOfAnEpisode) {
  FallbackOrder fallback(Box(), Values(0, 0), 3, absl::Seconds(1), 4, absl::ZeroDuration());
  const ActionValue answer = Values(1, 1);
  fallback.TakeFresh(answer.view(), absl::ZeroDuration());
  fallback.BeginEpisode();
  EXPECT_FALSE(fallback.Hold(absl::ZeroDuration()));
}

// A robot's computer that was suspended has an old action, and few beats since.
TEST(FallbackOrderTest, AnActionIsNotHeldForLongerThanItsBeatsTake) {
  FallbackOrder fallback(Box(), Values(0, 0), 3, absl::Seconds(1), 4, absl::ZeroDuration());
  const ActionValue answer = Values(1, 1);
  fallback.TakeFresh(answer.view(), absl::Seconds(7));
  EXPECT_TRUE(fallback.Hold(absl::Seconds(8)));
  EXPECT_FALSE(fallback.Hold(absl::Seconds(8) + absl::Nanoseconds(1)));
}

TEST(FallbackOrderTest, ChangesAreToldOnceAndOnlyThoseThatMatter) {
  FallbackOrder fallback(Box(), Values(0, 0), 1, absl::Seconds(1), 0, absl::ZeroDuration());
  const ActionValue answer = Values(1, 1);
  for (int i = 0; i < 3; ++i) {
    fallback.TakeFresh(answer.view(), absl::ZeroDuration());
    fallback.Hold(absl::ZeroDuration());
  }
  EXPECT_FALSE(fallback.has_change());
  fallback.TakeSafe(answer.view());
  fallback.TakeSafe(answer.view());
  const auto change = fallback.TakeChange();
  EXPECT_EQ(change->to, ActionSource::kSafe);
  EXPECT_EQ(change->beats, 1);
  EXPECT_FALSE(fallback.TakeChange().has_value());
}

// Adds beats to a log, and does with its requests what the server does.
class Robot {
 public:
  explicit Robot(size_t kept) : log(kept, 1, Box()) { log.set_history_limit(100); }

  void Beat(bool sees = true) {
    const float number = static_cast<float>(beats_++);
    log.Add({&number, sees ? 1u : 0u}, number, beats_);
    log.SetExecuted(Values(number, number).view());
  }

  // Sends the request of the oldest episode. Returns whether it asks for a decision.
  bool Ask() {
    v1::ActRequest request;
    log.FillRequest(&request);
    const int64_t begin = request.step() - request.history_size();
    const auto known = static_cast<int64_t>(session.size());
    EXPECT_LE(begin - request.skipped_rewards_size(), known);
    // Of a stored session, what was executed before the expected step may be lost.
    if (known > 0 && request.step() > known && request.skipped_rewards_size() == 0) {
      EXPECT_LT(begin, known);
    }
    for (int64_t step = known; step < begin; ++step) {
      session.push_back(NAN);  // of which only the reward is known
      const auto i = static_cast<int>(step - begin + request.skipped_rewards_size());
      rewards += request.skipped_rewards(i);
    }
    for (const v1::Beat& beat : request.history()) {
      EXPECT_TRUE(beat.has_executed());
      if (beat.step() < static_cast<int64_t>(session.size())) continue;
      EXPECT_EQ(beat.step(), static_cast<int64_t>(session.size()));
      session.push_back(beat.observation().empty() ? NAN : beat.observation(0));
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
  robot.log.Settle(/*is_stored=*/false).summary.set_value(v1::EndEpisodeResponse());
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
  robot.log.Settle(/*is_stored=*/false);
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
  EXPECT_EQ(robot.log.dropped(), 19);
  EXPECT_TRUE(robot.Ask());
  EXPECT_EQ(robot.rewards, 435.0);
  EXPECT_TRUE(std::isnan(robot.session[18]));
  EXPECT_EQ(robot.session[19], 19.0f);
}

// Whatever the server expects, it is told what was executed before, or the context starts behind.
TEST(BeatLogTest, AServerThatLostBeatsIsToldWhatWasExecutedBeforeThem) {
  for (const size_t kept : {2, 3, 5, 100}) {
    for (size_t known = 0; known < 12; ++known) {
      for (const bool ends : {false, true}) {
        Robot robot(kept);
        for (int i = 0; i < 12; ++i) {
          robot.Beat();
          robot.Ask();
        }
        robot.session.resize(known);
        EXPECT_TRUE(robot.log.Rewind(known, std::nullopt));
        if (ends) robot.log.End({.reward = 1.0});
        robot.Beat();
        EXPECT_EQ(robot.Ask(), !ends);
        EXPECT_EQ(robot.session.size(), ends ? 12 : 13);
        if (kept == 100) {
          EXPECT_FALSE(std::isnan(robot.session[known]));
        }
      }
    }
  }
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
  EXPECT_TRUE(robot.log.Rewind(16, std::nullopt));
  robot.Beat();
  EXPECT_TRUE(robot.Ask());
  EXPECT_EQ(robot.session.size(), 21);
  EXPECT_FALSE(robot.log.Rewind(22, std::nullopt));
}

// Its first answer may be that of a server that has died since.
TEST(BeatLogTest, ARequestSentAgainTellsWhatWasExecutedBefore) {
  Robot robot(100);
  for (int i = 0; i < 3; ++i) robot.Beat();
  EXPECT_TRUE(robot.Ask());
  v1::ActRequest request;
  robot.log.FillRequest(&request);
  EXPECT_EQ(request.step(), 2);
  EXPECT_EQ(request.history_size(), 1);
}

TEST(BeatLogTest, AStepWithoutAnObservationIsSentAsOne) {
  Robot robot(100);
  for (const bool sees : {true, true, false, false}) {
    robot.Beat(sees);
    EXPECT_EQ(robot.Ask(), sees);
  }
  robot.log.End({.reward = 1.0});
  EXPECT_FALSE(robot.Ask());
  EXPECT_EQ(robot.session.size(), 4);
  EXPECT_EQ(robot.session[1], 1.0f);
  EXPECT_TRUE(std::isnan(robot.session[2]) && std::isnan(robot.session[3]));
  EXPECT_EQ(robot.rewards, 6.0);
}

TEST(BeatLogTest, MoreBlindStepsThanAHistoryHasCountAsRewards) {
  Robot robot(1000);
  robot.log.set_history_limit(10);
  robot.Beat();
  EXPECT_TRUE(robot.Ask());
  for (int i = 0; i < 50; ++i) robot.Beat(/*sees=*/false);
  robot.Beat();
  EXPECT_TRUE(robot.Ask());
  EXPECT_EQ(robot.session.size(), 52);
  EXPECT_TRUE(std::isnan(robot.session[50]));
  EXPECT_EQ(robot.session[51], 51.0f);
  for (int i = 0; i < 50; ++i) robot.Beat(/*sees=*/false);
  robot.log.End({.reward = 1.0});
  EXPECT_FALSE(robot.Ask());
  EXPECT_EQ(robot.session.size(), 102);
  EXPECT_EQ(robot.rewards, 101.0 * 102.0 / 2.0);
}

// Plays an episode that the server answers wholly.
void EndAndSettle(int beats, Robot* robot, bool is_stored) {
  for (int i = 0; i < beats; ++i) robot->Beat();
  auto summary = robot->log.End({.reward = 1.0});
  robot->Ask();
  robot->session.clear();
  robot->log.Settle(is_stored).summary.set_value(v1::EndEpisodeResponse());
  EXPECT_TRUE(summary.get().ok());
}

TEST(BeatLogTest, TheEndOfAnEpisodeIsKeptUntilTheStoreHasIt) {
  Robot robot(100);
  for (const int beats : {3, 2, 4}) EndAndSettle(beats, &robot, /*is_stored=*/true);
  robot.Beat();
  EXPECT_TRUE(robot.Ask());
  robot.log.ForgetDurable(/*decisions=*/3, /*episodes=*/1);
  robot.log.ForgetDurable(6, 0);  // an older server: a decision behind the second end
  EXPECT_FALSE(robot.log.Rewind(4, 1));
  // The server has lost the last end, and two beats before it.
  EXPECT_TRUE(robot.log.Rewind(7, 2));
  EXPECT_EQ(robot.log.oldest().index, 2);
  robot.session = {5, 6};
  EXPECT_FALSE(robot.Ask());
  EXPECT_THAT(robot.session, ElementsAre(5, 6, 7, 8));
  EXPECT_TRUE(robot.log.is_complete());
  v1::EndEpisodeRequest end;
  robot.log.FillEnd(&end);
  EXPECT_EQ(end.steps(), 4);
  robot.log.Settle(true);
  robot.session.clear();
  EXPECT_TRUE(robot.Ask());
  EXPECT_THAT(robot.session, ElementsAre(9));
  // It has lost the end alone: the decision that it expects is the same.
  EXPECT_TRUE(robot.log.Rewind(9, 2));
  EXPECT_EQ(robot.log.oldest().index, 2);
  EXPECT_TRUE(robot.log.is_complete());
}

TEST(BeatLogTest, ASessionThatNoStoreHasKeepsNoEndedEpisode) {
  Robot robot(100);
  EndAndSettle(3, &robot, /*is_stored=*/false);
  robot.Beat();
  EXPECT_FALSE(robot.log.Rewind(2, 0));
}

// As far as its beats are kept; of older ones, their rewards. What is missing is counted.
TEST(BeatLogTest, ANewSessionHasTheWholeRunningEpisode) {
  Robot robot(10);
  for (int i = 0; i < 30; ++i) {
    robot.Beat();
    robot.Ask();
  }
  EXPECT_EQ(robot.log.dropped(), 0);
  robot.session.clear();
  robot.rewards = 0.0;
  EXPECT_TRUE(robot.log.BeginAgain().empty());
  robot.Beat();
  EXPECT_TRUE(robot.Ask());
  EXPECT_EQ(robot.session.size(), 31);
  EXPECT_EQ(robot.rewards, 465.0);
  EXPECT_EQ(robot.log.running().lost_steps, 0);
  // Beats that the server has refused are not sent to the next session.
  EXPECT_TRUE(robot.log.BeginAgain(/*keeps_beats=*/false).empty());
  robot.session.clear();
  robot.Beat();
  EXPECT_TRUE(robot.Ask());
  EXPECT_THAT(robot.session, ElementsAre(31));
  EXPECT_EQ(robot.log.running().lost_steps, 31);
}

TEST(SightTest, AnObservationHasItsSizeAndFiniteNumbers) {
  Blindness why;
  const float nan = NAN;
  EXPECT_TRUE(IsObservation({1.0f, 2.0f}, 2, &why));
  EXPECT_FALSE(IsObservation({1.0f}, 2, &why));
  EXPECT_EQ(why.ToString(), "observation: expected 2 numbers, received 1");
  EXPECT_FALSE(IsObservation({1.0f, nan}, 2, &why));
  EXPECT_EQ(why.ToString(), "observation[1]: expected a finite number, received nan");
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
