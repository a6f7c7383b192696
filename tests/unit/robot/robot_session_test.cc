// The transitions of docs/reference/beats.md that the simulator does not tell from others.
#include "core/robot/robot_session.h"

#include <gtest/gtest.h>

#include <optional>

namespace spikeserve::robot {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using What = Task::Kind;

Error ErrorOf(Failure kind) { return {.kind = kind, .message = "why", .text = "why"}; }

class RobotSessionTest : public ::testing::Test {
 protected:
  static constexpr Time kPeriod = milliseconds(20);

  void Open(bool is_stored, size_t servers = 1, bool has_engine = false, bool shares_head = false) {
    robot_.emplace(Settings{.observation_size = 1,
                            .period = kPeriod,
                            .oldest = milliseconds(250),
                            .oldest_held = milliseconds(310),
                            .hold_steps = 3,
                            .most_in_flight = 4,
                            .kept_steps = 100,
                            .servers = servers,
                            .has_engine = has_engine,
                            .shares_head = shares_head},
                   ActionShape(10, {}, {}), Opening{.history_limit = 100, .is_stored = is_stored},
                   Clock());
  }

  // As Open, and opens the stream.
  void Connect(bool is_stored, size_t servers = 1, bool has_engine = false,
               bool shares_head = false) {
    Open(is_stored, servers, has_engine, shares_head);
    EXPECT_EQ(Next(), What::kOpenStream);
    robot_->OnStreamOpened(0);
    EXPECT_EQ(robot_->link(), LinkState::kOnline);
  }

  Now Clock() const { return {now_, now_}; }
  What Next() { return robot_->Next(now_).kind; }

  // A control step that waits for nothing.
  StepResult Step(float observation = 1.0f) {
    now_ += kPeriod;
    EXPECT_TRUE(robot_->BeginStep({.observation = {&observation, 1}, .reward = 1.0}, Clock()));
    if (robot_->Choose(Clock(), now_) == Choice::kOwnAction) {
      const ActionView own = {.discrete = 0};
      robot_->TakeOwn(&own);
    }
    return robot_->FinishStep(Clock());
  }

  // A control step whose request is sent.
  void Ask() {
    Step();
    EXPECT_EQ(Next(), What::kSend);
  }

  void Fail(const Error& error) { robot_->OnReply({.error = &error}, Clock()); }

  Received Answer(int64_t next_step, bool has_ended = false) {
    return robot_->OnReply({.next_step = next_step,
                            .action = ActionView{.discrete = 7},
                            .observed_at = now_,
                            .has_ended = has_ended},
                           Clock());
  }

  // Takes the tasks of a session that is lost.
  void ExpectForgotten() {
    EXPECT_EQ(robot_->link(), LinkState::kGivenUp);
    EXPECT_EQ(Next(), What::kForget);
    EXPECT_EQ(robot_->link(), LinkState::kNoSession);
  }

  Time now_ = Time::zero();
  std::optional<RobotSession> robot_;
};

TEST_F(RobotSessionTest, AHeldRobotIsSafeUntilAnAnswerWithoutAHold) {
  Connect(/*is_stored=*/true, /*servers=*/2);
  Ask();
  Answer(1);
  EXPECT_EQ(Step().source, Source::kFresh);
  EXPECT_EQ(Next(), What::kSend);
  robot_->OnReply({.next_step = 2, .stays_safe = true}, Clock());  // it has no action
  EXPECT_TRUE(robot_->stays_safe());
  EXPECT_EQ(Step().source, Source::kSafe);  // the last action is not held
  EXPECT_EQ(Next(), What::kSend);
  robot_->OnReply({.next_step = 3,
                   .action = ActionView{.discrete = 7},
                   .observed_at = now_,
                   .stays_safe = true},
                  Clock());
  EXPECT_EQ(Step().source, Source::kSafe);

  robot_->OnStreamEnded(ErrorOf(Failure::kAway));
  EXPECT_EQ(Next(), What::kCloseStream);
  robot_->OnStreamClosed(/*is_renewed=*/true, now_);
  for (int i = 0; i < 10; ++i) EXPECT_EQ(Step().source, Source::kSafe);
  EXPECT_EQ(Next(), What::kOpenStream);
  robot_->OnStreamOpened(1);
  Ask();
  EXPECT_EQ(Step().source, Source::kSafe);
  Answer(robot_->step_log().next() - 1);
  EXPECT_EQ(Step().source, Source::kFresh);
  EXPECT_FALSE(robot_->stays_safe());
}

TEST_F(RobotSessionTest, AStepWaitsForAnAnswerThatShouldArriveInTime) {
  Connect(false);
  const float observation = 1.0f;
  ASSERT_TRUE(robot_->BeginStep({.observation = {&observation, 1}}, Clock()));
  EXPECT_EQ(robot_->Choose(Clock(), now_ + milliseconds(10)), Choice::kWait);
  EXPECT_EQ(Next(), What::kSend);
  EXPECT_EQ(robot_->Choose(Clock(), now_ + milliseconds(10)), Choice::kWait);
  robot_->OnStreamEnded(ErrorOf(Failure::kAway));  // nobody waits for it any more
  EXPECT_EQ(robot_->Choose(Clock(), now_ + milliseconds(10)), Choice::kOwnAction);
}

TEST_F(RobotSessionTest, ARobotMaySendByItself) {
  Connect(false);
  EXPECT_FALSE(robot_->NextSend(now_).has_value());
  Step();
  const std::optional<Task> task = robot_->NextSend(now_);
  ASSERT_TRUE(task.has_value());
  EXPECT_EQ(task->kind, What::kSend);
  EXPECT_TRUE(task->request.asks);
  EXPECT_FALSE(robot_->NextSend(now_).has_value());
  EXPECT_EQ(Next(), What::kWait);
  robot_->OnStreamEnded(ErrorOf(Failure::kAway));
  Step();
  EXPECT_FALSE(robot_->NextSend(now_).has_value());  // what else is to be done is not for it
  EXPECT_EQ(Next(), What::kCloseStream);
}

TEST_F(RobotSessionTest, BeforeAValidObservationThereIsNoStep) {
  Connect(false);
  EXPECT_FALSE(robot_->BeginStep({.observation = {}}, Clock()));
  EXPECT_EQ(robot_->step_log().next(), 0);
  EXPECT_EQ(robot_->counters().counts().invalid, 1);
}

TEST_F(RobotSessionTest, AFreshConnectionIsUsedAtOnce) {
  Connect(false);
  robot_->OnStreamEnded(ErrorOf(Failure::kAway));
  EXPECT_FALSE(robot_->OnStreamClosed(/*is_renewed=*/true, now_));
  EXPECT_EQ(Next(), What::kOpenStream);
}

TEST_F(RobotSessionTest, AServerThatIsBusyIsAskedLater) {
  Connect(false);
  Ask();
  Error error = ErrorOf(Failure::kOther);
  error.retry_after = seconds(1);
  Fail(error);
  EXPECT_EQ(robot_->link(), LinkState::kOnline);
  Step();
  EXPECT_EQ(Next(), What::kWait);
  now_ += seconds(1);
  Ask();
}

TEST_F(RobotSessionTest, ADeniedSessionIsLostAfterTwoSecondsIfAStoreHasIt) {
  Connect(true, /*servers=*/2);
  Ask();
  Fail(ErrorOf(Failure::kNotFound));
  EXPECT_EQ(robot_->link(), LinkState::kBroken);
  EXPECT_TRUE(robot_->HasDenied(0));
  robot_->OnStreamClosed(false, now_);
  now_ += seconds(2);
  EXPECT_EQ(Next(), What::kOpenStream);
  robot_->OnStreamOpened(1);
  Ask();
  Fail(ErrorOf(Failure::kNotFound));
  ExpectForgotten();
}

struct Loss {
  Failure kind;
  bool is_lost;
  uint64_t steps;  // of the running episode that the next session gets
};

class RobotSessionLossTest : public RobotSessionTest, public ::testing::WithParamInterface<Loss> {};

TEST_P(RobotSessionLossTest, AnErrorDecidesWhatBecomesOfASessionThatNoStoreHas) {
  Connect(false);
  Ask();
  Ask();
  Fail(ErrorOf(GetParam().kind));
  if (!GetParam().is_lost) {
    EXPECT_EQ(robot_->link(), LinkState::kBroken);
    EXPECT_TRUE(robot_->OnStreamClosed(false, now_));
    return;
  }
  ExpectForgotten();
  EXPECT_EQ(robot_->step_log().running().steps, GetParam().steps);
  EXPECT_EQ(Next(), What::kOpenSession);
  EXPECT_EQ(Next(), What::kWait);  // one call at a time
  robot_->OnOpened({.history_limit = 100});
  EXPECT_EQ(robot_->link(), LinkState::kNoStream);
  EXPECT_EQ(robot_->counters().counts().reopened, 1);
}

INSTANTIATE_TEST_SUITE_P(Errors, RobotSessionLossTest,
                         ::testing::Values(Loss{Failure::kNotFound, true, 2},
                                           Loss{Failure::kConflict, true, 2},
                                           Loss{Failure::kInvalid, true, 0},
                                           Loss{Failure::kAway, false, 2},
                                           Loss{Failure::kOther, false, 2}));

TEST_F(RobotSessionTest, ASilentServerIsDoubtedThenLeft) {
  Connect(true, /*servers=*/2);
  Ask();
  now_ += milliseconds(300);
  EXPECT_EQ(Next(), What::kDoubtLine);
  now_ += milliseconds(700);
  EXPECT_EQ(Next(), What::kCloseStream);
  EXPECT_TRUE(robot_->OnStreamClosed(false, now_));
  EXPECT_EQ(robot_->counters().counts().cancelled_requests, 1);
}

TEST_F(RobotSessionTest, TheOnlyServerIsNotLeft) {
  Connect(true);
  Ask();
  now_ += seconds(5);
  EXPECT_EQ(Next(), What::kDoubtLine);
  EXPECT_EQ(Next(), What::kWait);
  EXPECT_EQ(robot_->link(), LinkState::kOnline);
}

// A server that repeats its answer may know the steps alone.
TEST_F(RobotSessionTest, ASummaryHasTheRobotsOwnReturn) {
  Connect(true);
  for (const std::optional<double> at_server : {std::optional(3.0), {}, std::optional(2.0)}) {
    for (int i = 0; i < 3; ++i) Ask();
    for (int i = 0; i < 3; ++i) Answer(i + 1);
    robot_->EndEpisode({.reward = 1.0}, nullptr);
    EXPECT_TRUE(robot_->Next(now_).request.ends);
    robot_->TakeLines();
    const Received received =
        robot_->OnReply({.has_ended = true, .episode_return = at_server}, Clock());
    ASSERT_TRUE(received.settled.has_value());
    EXPECT_EQ(received.settled->steps, 3);
    EXPECT_EQ(received.settled->episode_return, 3.0);
    const bool is_equal = at_server.value_or(3.0) == 3.0;
    EXPECT_EQ(robot_->counters().counts().unequal_returns, is_equal ? 0 : 1);
    EXPECT_EQ(robot_->TakeLines().size(), is_equal ? 0 : 1);
  }
}

TEST_F(RobotSessionTest, AStaleAnswerHalvesTheBudgetAndAnotherOneAddsToIt) {
  Connect(false);
  for (int i = 0; i < 4; ++i) Ask();
  Step();
  EXPECT_EQ(Next(), What::kWait);
  robot_->OnReply(
      {.next_step = 1, .action = ActionView{.discrete = 7}, .observed_at = now_ - seconds(1)},
      Clock());
  EXPECT_EQ(robot_->counters().counts().stale, 1);
  Step();
  EXPECT_EQ(Next(), What::kWait);
  Answer(2);
  Ask();
}

TEST_F(RobotSessionTest, AnEngineWithAFleetsHeadIsRenewedAfterEachEpisode) {
  Connect(true, 1, /*has_engine=*/true, /*shares_head=*/true);
  EXPECT_EQ(Next(), What::kExportSession);
  robot_->OnExported(0, 0, 0, now_);
  Ask();
  Answer(1);
  const ActionView action = {.discrete = 3};
  EXPECT_EQ(Next(), What::kPlay);
  robot_->OnPlayed(&action, "", now_);
  robot_->EndEpisode({.reward = 1.0}, nullptr);
  EXPECT_EQ(Next(), What::kPlay);
  EXPECT_TRUE(robot_->work().is_end);
  robot_->OnPlayed(&action, "", now_);
  EXPECT_EQ(Next(), What::kEndEpisode);
  robot_->OnEpisodeEnded(2.0);
  EXPECT_EQ(robot_->local().state(), LocalState::kStale);
  EXPECT_EQ(Next(), What::kExportSession);
}

TEST_F(RobotSessionTest, AnEngineGoesOnFromAnExport) {
  Connect(true, 1, /*has_engine=*/true);
  EXPECT_EQ(Next(), What::kExportSession);
  EXPECT_FALSE(robot_->OnExported(9, 0, 9, now_));  // of steps that nobody has
  EXPECT_EQ(robot_->local().state(), LocalState::kWanted);
  now_ += milliseconds(50);
  EXPECT_EQ(Next(), What::kExportSession);
  EXPECT_TRUE(robot_->OnExported(0, 0, 0, now_));
  EXPECT_EQ(robot_->local().state(), LocalState::kReady);
  Ask();
  EXPECT_EQ(Next(), What::kPlay);
  EXPECT_EQ(robot_->work().step, 0);
  robot_->OnPlayed(nullptr, "it failed", now_);
  EXPECT_EQ(robot_->local().state(), LocalState::kWanted);
}

TEST_F(RobotSessionTest, AnEngineThatCannotPlayIsNotAskedAgain) {
  Connect(true, 1, /*has_engine=*/true);
  EXPECT_EQ(Next(), What::kExportSession);
  robot_->OnCallFailed(ErrorOf(Failure::kConflict), 0, now_);
  EXPECT_EQ(robot_->local().state(), LocalState::kUnfit);
  EXPECT_EQ(Next(), What::kWait);
}

TEST_F(RobotSessionTest, ALocalActionFollowsTheHeldOnes) {
  Connect(true, 1, /*has_engine=*/true);
  EXPECT_EQ(Next(), What::kExportSession);
  robot_->OnExported(0, 0, 0, now_);
  const float observation = 1.0f;
  ASSERT_TRUE(robot_->BeginStep({.observation = {&observation, 1}}, Clock()));
  EXPECT_EQ(Next(), What::kSend);
  EXPECT_EQ(Next(), What::kPlay);
  const ActionView action = {.discrete = 3};
  robot_->OnPlayed(&action, "", now_);
  EXPECT_EQ(robot_->Choose(Clock(), now_), Choice::kTaken);
  EXPECT_EQ(robot_->FinishStep(Clock()).source, Source::kLocal);
}

TEST_F(RobotSessionTest, AClosedSessionStopsWhenItsEndsAreKnown) {
  Connect(false);
  Ask();
  robot_->EndEpisode({.reward = 1.0}, nullptr);
  robot_->Close(now_ + seconds(5));
  EXPECT_EQ(Next(), What::kSend);
  EXPECT_EQ(Next(), What::kWait);
  Answer(1);
  Answer(0, /*has_ended=*/true);
  EXPECT_EQ(Next(), What::kStop);
  EXPECT_TRUE(robot_->Stop());
  EXPECT_EQ(robot_->link(), LinkState::kClosed);
  EXPECT_FALSE(robot_->EndEpisode({.reward = 1.0}, nullptr).has_value());
  EXPECT_EQ(Step().source, Source::kSafe);
}

TEST_F(RobotSessionTest, AClosedSessionStopsAtItsTime) {
  Connect(false);
  Step();
  robot_->EndEpisode({.reward = 1.0}, nullptr);
  robot_->OnStreamEnded(ErrorOf(Failure::kAway));
  robot_->Close(now_ + milliseconds(10));
  EXPECT_EQ(Next(), What::kCloseStream);
  robot_->OnStreamClosed(false, now_);
  EXPECT_EQ(Next(), What::kWait);
  now_ += milliseconds(10);
  EXPECT_EQ(Next(), What::kStop);
  robot_->Stop();
  EXPECT_EQ(robot_->step_log().lost_episodes(), 1);
}

TEST_F(RobotSessionTest, TooManyMissedEpisodesLoseTheSession) {
  Open(false);
  for (int i = 0; i < 4097; ++i) {
    Step();
    robot_->EndEpisode({.reward = 1.0}, nullptr);
  }
  EXPECT_EQ(Next(), What::kForget);
  EXPECT_EQ(robot_->step_log().lost_episodes(), 4097);
}

// The background thread may be late: the step is of the history of the end then.
TEST_F(RobotSessionTest, AnEpisodeThatEndsBeforeItsLastRequestIsSentAsksForNothingMore) {
  Connect(false);
  Step();
  robot_->EndEpisode({.reward = 1.0}, nullptr);
  EXPECT_TRUE(robot_->Next(now_).request.ends);
  EXPECT_EQ(Next(), What::kWait);
}

}  // namespace
}  // namespace spikeserve::robot
