#include "core/agent/agent_session.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <numeric>
#include <set>

#include "core/agent/repeated_step.h"
#include "core/engine/energy.h"
#include "core/journal/session_bytes.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr double kInfinity = std::numeric_limits<double>::infinity();

class AgentSessionTest : public ::testing::Test {
 protected:
  AgentSession NewAgent(SessionOptions options = SmallOptions()) {
    return AgentSession(served_, NewSession("id", std::move(options)), &clock_);
  }

  Answer MustAct(AgentSession& agent, int64_t step) {
    const auto answer = agent.Act(step, ObservationAt(step), RewardAt(step));
    EXPECT_TRUE(answer.ok()) << answer.status();
    return answer.ok() ? **answer : Answer();
  }

  // Expects that `status` has this code and message, and that the session still has the bytes
  // `before`.
  void ExpectRefusal(AgentSession& agent, absl::StatusCode code, const std::string& message,
                     absl::Status status, const std::string& before) {
    EXPECT_EQ(status.code(), code) << status;
    EXPECT_THAT(std::string(status.message()), HasSubstr(message));
    EXPECT_EQ(SerializeSession(agent.session()), before);
  }

  FakeClock clock_;
  std::shared_ptr<RecordingObserver> observer_ = std::make_shared<RecordingObserver>();
  std::shared_ptr<const ServedPolicy> served_ =
      Serve(SmallConfig(), ActionSpace::Discrete(2), observer_);
};

TEST_F(AgentSessionTest, ReturnToGoFallsByTheRewards) {
  AgentSession agent = NewAgent();
  double expected = 10.0;
  for (int64_t t = 0; t < 30; ++t) {
    if (t > 0) expected -= RewardAt(t);
    EXPECT_EQ(MustAct(agent, t).return_to_go, static_cast<float>(expected)) << t;
    EXPECT_EQ(agent.session().return_to_go, expected) << t;
  }
}

TEST_F(AgentSessionTest, RewardIsIgnoredAtStepZero) {
  AgentSession agent = NewAgent();
  for (const double reward : {kNan, kInfinity, 5.0}) {
    const auto answer = agent.Act(0, ObservationAt(0), reward);
    ASSERT_TRUE(answer.ok()) << answer.status();
    EXPECT_EQ((*answer)->return_to_go, 10.0f);
    EXPECT_EQ(agent.session().episode_return, 0.0);
    ASSERT_TRUE(agent.EndEpisode({.reward = 0.0, .target_return = {}}).ok());
  }
}

TEST_F(AgentSessionTest, RetryGetsTheStoredAnswerAndCountsNothing) {
  AgentSession agent = NewAgent();
  for (int64_t t = 0; t < 12; ++t) {
    const Answer answer = MustAct(agent, t);
    const std::string before = SerializeSession(agent.session());
    clock_.Advance(absl::Seconds(1));
    if (t % 2 == 0) agent.AppendPendingAction();
    if (t % 3 == 0) agent.DropContext();
    const auto retry = agent.Act(t, ObservationAt(t), t == 0 ? kNan : RewardAt(t));
    ASSERT_TRUE(retry.ok()) << retry.status();
    EXPECT_EQ(**retry, answer);
    EXPECT_EQ(SerializeSession(agent.session()), before);
  }
  EXPECT_EQ(observer_->decisions.size(), 12u);
}

// Of a second robot with the same session id: it would get the answers of the first one.
TEST_F(AgentSessionTest, ARepeatedStepWithAnotherContentIsRefused) {
  AgentSession agent = NewAgent();
  for (int64_t t = 0; t < 3; ++t) MustAct(agent, t);
  const int64_t one = 1;
  const int64_t zero = 0;
  ASSERT_TRUE(agent.Act(3, ObservationAt(3), 0.5, one).ok());
  const std::string before = SerializeSession(agent.session());
  std::vector<float> other = ObservationAt(3);
  other[2] = 0.25f;
  const auto refuse = [&](const std::string& message, const std::vector<float>& observation,
                          double reward, const std::optional<ReportedAction>& executed) {
    absl::Status status = agent.Act(3, observation, reward, executed).status();
    EXPECT_TRUE(TakeConflict(&status)) << status;
    ExpectRefusal(agent, absl::StatusCode::kFailedPrecondition, message, status, before);
  };
  const std::vector<float> same = ObservationAt(3);
  refuse("observation[2]: expected ", other, 0.5, one);
  refuse(" for step 3, received 0.25; another robot", other, 0.5, one);
  refuse("observation: expected 3 numbers", {1.0f}, 0.5, one);
  refuse("reward: expected about 0.5", same, 0.75, one);
  refuse(", received nan", same, kNan, one);
  refuse("executed_action: expected index 1 ", same, 0.5, zero);
  EXPECT_TRUE(agent.Act(3, same, 0.5, one).ok());
  EXPECT_TRUE(agent.Act(3, same, 0.5).ok());  // says nothing of the action
  EXPECT_EQ(observer_->decisions.size(), 4u);
}

// As far as a float32 of the return-to-go tells rewards apart.
TEST_F(AgentSessionTest, ARepeatedRewardIsKnownAgain) {
  AgentSession agent = NewAgent();
  MustAct(agent, 0);
  for (int64_t t = 1; t < 400; ++t) {
    const double reward = (t % 7 == 0 ? 1e5 : 1.0) * std::sin(static_cast<double>(t));
    ASSERT_TRUE(agent.Act(t, ObservationAt(t), reward).ok());
    const auto again = agent.Act(t, ObservationAt(t), reward);
    ASSERT_TRUE(again.ok()) << again.status();
    EXPECT_FALSE(agent.Act(t, ObservationAt(t), reward + 0.1).ok());
  }
}

TEST_F(AgentSessionTest, OtherStepsAreRefused) {
  AgentSession agent = NewAgent();
  for (int64_t t = 0; t < 3; ++t) MustAct(agent, t);
  const std::string before = SerializeSession(agent.session());
  for (const int64_t step : {int64_t{-1}, int64_t{0}, int64_t{1}, int64_t{4}}) {
    ExpectRefusal(agent, absl::StatusCode::kFailedPrecondition,
                  "step: expected 3, received " + std::to_string(step),
                  agent.Act(step, ObservationAt(step), 0.0).status(), before);
  }
}

TEST_F(AgentSessionTest, BadNumbersAreRefused) {
  AgentSession agent = NewAgent();
  MustAct(agent, 0);
  const std::string before = SerializeSession(agent.session());
  const auto refuse = [&](std::vector<float> observation, double reward,
                          const std::string& message) {
    ExpectRefusal(agent, absl::StatusCode::kInvalidArgument, message,
                  agent.Act(1, observation, reward).status(), before);
  };
  refuse({}, 0.0, "observation: expected 3 numbers, received 0");
  refuse({1, 2, 3, 4}, 0.0, "observation: expected 3 numbers, received 4");
  refuse({1, 2, static_cast<float>(kNan)}, 0.0, "observation[2]: expected a finite number");
  refuse({1, -static_cast<float>(kInfinity), 3}, 0.0, "observation[1]: expected a finite number");
  refuse({1, 2, 3}, kNan, "reward: expected a finite number, received nan");
  refuse({1, 2, 3}, -kInfinity, "reward: expected a finite number, received -inf");
  refuse({1, 2, 3}, 1e300, "reward: expected a return-to-go within float32, received 1e+300");
  MustAct(agent, 1);
  EXPECT_EQ(observer_->decisions.size(), 2u);
}

TEST_F(AgentSessionTest, EndEpisodeSumsUpAndStartsTheNext) {
  AgentSession agent = NewAgent();
  uint64_t spikes = 0;
  double energy = 0.0;
  for (int64_t t = 0; t < 4; ++t) {
    const Counts counts = MustAct(agent, t).counts;
    spikes += counts.total_spikes();
    energy += DefaultEnergy(counts, served_->policy().config);
  }
  const auto summary = agent.EndEpisode({.reward = 2.0, .target_return = 3.0});
  ASSERT_TRUE(summary.ok()) << summary.status();
  EXPECT_DOUBLE_EQ(summary->episode_return, 0.1 + 0.2 + 0.0 + 2.0);
  EXPECT_EQ(summary->steps, 4);
  EXPECT_EQ(summary->spikes, spikes);
  EXPECT_DOUBLE_EQ(summary->energy_joules, energy);
  EXPECT_THAT(observer_->returns, ::testing::ElementsAre(summary->episode_return));

  EXPECT_EQ(agent.session().episode, 1);
  EXPECT_EQ(agent.session().step, 0);
  EXPECT_EQ(MustAct(agent, 0).return_to_go, 3.0f);
  EXPECT_EQ(agent.session().spikes, spikes + observer_->decisions.back().counts.total_spikes());
  ASSERT_TRUE(agent.EndEpisode({.reward = 0.0, .target_return = {}}).ok());
  EXPECT_EQ(agent.session().target_return, 10.0);
}

TEST_F(AgentSessionTest, RepeatedEndOfEpisodeCountsOnceAndIsAnsweredAgain) {
  AgentSession agent = NewAgent();
  MustAct(agent, 0);
  const EpisodeEnd end = {.reward = 1.0, .terminated = true, .target_return = 3.0};
  const auto first = agent.EndEpisode(end);
  ASSERT_TRUE(first.ok()) << first.status();
  const std::string before = SerializeSession(agent.session());

  // The answer is the same if the session was moved to another server in between.
  AgentSession moved(served_, *ParseSession(before), &clock_);
  for (AgentSession* asked : {&agent, &moved}) {
    const auto again = asked->EndEpisode(end);
    ASSERT_TRUE(again.ok()) << again.status();
    EXPECT_EQ(again->episode_return, first->episode_return);
    EXPECT_EQ(again->steps, first->steps);
    EXPECT_EQ(again->spikes, first->spikes);
    EXPECT_EQ(again->energy_joules, first->energy_joules);
    EXPECT_EQ(SerializeSession(asked->session()), before);
  }
  EXPECT_EQ(observer_->returns.size(), 1u);
}

TEST_F(AgentSessionTest, AnotherEndWithoutADecisionIsRefused) {
  AgentSession agent = NewAgent();
  const auto refuse = [&](const EpisodeEnd& end) {
    const std::string before = SerializeSession(agent.session());
    ExpectRefusal(agent, absl::StatusCode::kFailedPrecondition,
                  "expected at least one decision since the last episode ended",
                  agent.EndEpisode(end).status(), before);
  };
  refuse({});
  MustAct(agent, 0);
  ASSERT_TRUE(agent.EndEpisode({.reward = 1.0}).ok());
  refuse({.reward = 2.0});
  refuse({.reward = 1.0, .terminated = true});
  refuse({.reward = 1.0, .target_return = 4.0});
  EXPECT_EQ(observer_->returns.size(), 1u);
}

TEST_F(AgentSessionTest, BadEndOfEpisodeIsRefused) {
  AgentSession agent = NewAgent();
  MustAct(agent, 0);
  const std::string before = SerializeSession(agent.session());
  ExpectRefusal(agent, absl::StatusCode::kInvalidArgument, "reward: expected a finite number",
                agent.EndEpisode({.reward = kNan, .target_return = {}}).status(), before);
  ExpectRefusal(agent, absl::StatusCode::kInvalidArgument,
                "target_return: expected a finite number",
                agent.EndEpisode({.reward = 0.0, .target_return = kInfinity}).status(), before);
}

TEST_F(AgentSessionTest, ASecondEpisodeEqualsTheFirst) {
  AgentSession agent = NewAgent();
  std::vector<Answer> first;
  for (int64_t t = 0; t < 9; ++t) first.push_back(MustAct(agent, t));
  ASSERT_TRUE(agent.EndEpisode({.reward = 0.0, .target_return = {}}).ok());
  for (int64_t t = 0; t < 9; ++t) EXPECT_EQ(MustAct(agent, t), first[static_cast<size_t>(t)]);
}

TEST_F(AgentSessionTest, HistoryIsBounded) {
  AgentSession agent = NewAgent();
  const auto limit = static_cast<size_t>(HistorySize(SmallConfig()));
  for (int64_t t = 0; t < 40; ++t) MustAct(agent, t);
  EXPECT_EQ(agent.session().history.size(), limit);
  EXPECT_EQ(agent.session().history.at(limit - 1).observation, ObservationAt(39));
}

TEST_F(AgentSessionTest, ComputeTimeIsTheClocks) {
  AgentSession agent = NewAgent();
  EXPECT_EQ(MustAct(agent, 0).compute_seconds, 0.0);
}

// One policy of each kind whose answers could depend on more than the history.
struct CacheCase {
  std::string name;
  ModelConfig config;
  ActionSpace action_space;
  ActionSelection selection;
};

std::vector<CacheCase> CacheCases() {
  ModelConfig dense = SmallConfig();
  dense.mode = Mode::kDense;
  ModelConfig deep = SmallConfig();
  deep.layers = 3;
  ModelConfig changes = SmallConfig();
  changes.observation_changes = true;
  ModelConfig changes_alone = changes;
  changes_alone.context = 1;
  const ActionSelection sampled = {.sample = true, .temperature = 2.0f};
  return {{"Changes", changes, ActionSpace::Discrete(3), {}},
          {"ChangesInAContextOfOne", changes_alone, ActionSpace::Box({-2.0f}, {2.0f}), {}},
          {"Greedy", SmallConfig(), ActionSpace::Discrete(3), {}},
          {"Sampled", SmallConfig(), ActionSpace::Discrete(3), sampled},
          {"SampledBox", SmallConfig(), ActionSpace::Box({-2.0f}, {2.0f}), sampled},
          {"Deep", deep, ActionSpace::Discrete(3), {}},
          {"Dense", dense, ActionSpace::Discrete(3), {}}};
}

class SessionCacheTest : public ::testing::TestWithParam<CacheCase> {
 protected:
  AgentSession NewAgent() {
    SessionOptions options = SmallOptions();
    options.action_selection = GetParam().selection;
    return AgentSession(served_, NewSession("id", std::move(options)), &clock_);
  }

  FakeClock clock_;
  std::shared_ptr<const ServedPolicy> served_ = Serve(GetParam().config, GetParam().action_space);
};

// Drops the cache before some steps, restores the session from its bytes before others, and leaves
// some actions pending. Answers and counts stay equal over many more steps than the window holds.
TEST_P(SessionCacheTest, AnswersDoNotDependOnTheCache) {
  AgentSession steady = NewAgent();
  AgentSession disturbed = NewAgent();
  for (int64_t t = 0; t < 50; ++t) {
    if (t % 5 == 3) disturbed.DropContext();
    if (t % 7 == 0) disturbed.Compact();
    if (t % 11 == 4) {
      auto restored = ParseSession(SerializeSession(disturbed.session()));
      ASSERT_TRUE(restored.ok()) << restored.status();
      disturbed = AgentSession(served_, *std::move(restored), &clock_);
    }
    const auto expected = steady.Act(t, ObservationAt(t), RewardAt(t));
    const auto actual = disturbed.Act(t, ObservationAt(t), RewardAt(t));
    ASSERT_TRUE(expected.ok() && actual.ok());
    ASSERT_EQ(**actual, **expected) << "step " << t;
    if (t % 2 == 0) steady.AppendPendingAction();
    if (t % 3 == 0) disturbed.AppendPendingAction();
  }
  EXPECT_EQ(SerializeSession(disturbed.session()), SerializeSession(steady.session()));
}

INSTANTIATE_TEST_SUITE_P(Policies, SessionCacheTest, ::testing::ValuesIn(CacheCases()),
                         [](const auto& test) { return test.param.name; });

TEST(SampledSessionTest, DrawsFollowTheSeed) {
  const auto served = Serve(SmallConfig(), ActionSpace::Discrete(4));
  FakeClock clock;
  const auto play = [&](uint64_t seed) {
    SessionOptions options = SmallOptions();
    options.seed = seed;
    options.action_selection = {.sample = true, .temperature = 5.0f};
    AgentSession agent(served, NewSession("id", options), &clock);
    std::vector<int> actions;
    for (int64_t t = 0; t < 30; ++t) {
      actions.push_back((*agent.Act(t, ObservationAt(t), 0.0))->action.discrete);
    }
    return actions;
  };
  EXPECT_EQ(play(1), play(1));
  EXPECT_NE(play(1), play(2));
  const std::vector<int> actions = play(1);
  EXPECT_GT(std::set<int>(actions.begin(), actions.end()).size(), 1u);
}

}  // namespace
}  // namespace spikeserve
