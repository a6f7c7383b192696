#include "core/agent/agent_session.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <memory>
#include <vector>

#include "core/agent/shadow_session.h"
#include "core/journal/session_bytes.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

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

  FakeClock clock_;
  std::shared_ptr<const ServedPolicy> served_ = Serve(SmallConfig(), ActionSpace::Discrete(2));
};

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

class ActTogetherTest : public ::testing::Test {
 protected:
  static SessionOptions Options(int i) {
    SessionOptions options = SmallOptions();
    options.seed = static_cast<uint64_t>(i);
    options.action_selection.sample = i % 2 == 1;
    options.target_return += i;
    if (i % 3 == 2) options.learning.emplace();
    return options;
  }

  // Returns sessions that alternate between two versions; some sample and some learn.
  std::vector<std::unique_ptr<AgentSession>> NewSessions() {
    std::vector<std::unique_ptr<AgentSession>> sessions;
    for (int i = 0; i < 8; ++i) {
      sessions.push_back(std::make_unique<AgentSession>(i % 2 == 0 ? even_ : odd_,
                                                        NewSession("id", Options(i)), &clock_));
    }
    return sessions;
  }

  static void Apply(std::vector<Step>& steps) {
    std::vector<Step*> all;
    for (Step& step : steps) all.push_back(&step);
    AgentSession::Apply(all);
  }

  FakeClock clock_;
  std::shared_ptr<const ServedPolicy> even_ = Serve(SmallConfig(), ActionSpace::Discrete(2));
  std::shared_ptr<const ServedPolicy> odd_ = Serve(SmallConfig(), ActionSpace::Discrete(3));
};

TEST_F(ActTogetherTest, EqualsOneAfterTheOtherBitForBit) {
  const auto alone = NewSessions();
  const auto together = NewSessions();
  for (int64_t step = 0; step < 30; ++step) {
    std::vector<std::vector<float>> observations;
    for (size_t i = 0; i < together.size(); ++i) {
      observations.push_back(ObservationAt(step + static_cast<int64_t>(i)));
    }
    std::vector<Step> steps;
    std::vector<AgentSession*> sessions;
    for (size_t i = 0; i < together.size(); ++i) {
      steps.push_back({.session = together[i].get(),
                       .place = {.step = step},
                       .observation = observations[i],
                       .reward = RewardAt(step)});
      sessions.push_back(together[i].get());
    }
    if (step % 7 == 3) together[2]->DropContext();
    Apply(steps);
    for (size_t i = 0; i < alone.size(); ++i) {
      ASSERT_TRUE(alone[i]->Act(step, observations[i], RewardAt(step)).ok());
      ASSERT_TRUE(steps[i].result.status.ok()) << steps[i].result.status;
      EXPECT_FALSE(steps[i].result.is_retry);
      EXPECT_EQ(SerializeSession(together[i]->session()), SerializeSession(alone[i]->session()))
          << "session " << i << " at step " << step;
    }
    if (step % 3 == 0) AgentSession::AppendPendingActions(sessions);
  }
}

class ShadowSessionTest : public ::testing::Test {
 protected:
  // Makes the next decision of the served session and returns it as input for the shadow.
  ShadowStep Serve(AgentSession& agent) {
    const int64_t step = agent.session().step;
    const auto answer = agent.Act(step, ObservationAt(step), 0.5);
    EXPECT_TRUE(answer.ok()) << answer.status();
    return {.episode = agent.session().episode,
            .step = step,
            .observation = ObservationAt(step),
            .reward = 0.5,
            .target_return = agent.session().target_return,
            .served = **answer};
  }

  FakeClock clock_;
  std::shared_ptr<const ServedPolicy> policy_ =
      spikeserve::Serve(SmallConfig(), ActionSpace::Discrete(3));
  AgentSession agent_{policy_, NewSession("served", SmallOptions()), &clock_};
  ShadowSession shadow_{*policy_, SmallOptions(), &clock_};
};

TEST_F(ShadowSessionTest, ItsWindowHoldsTheActionsThatWereExecuted) {
  for (int step = 0; step < 20; ++step) {
    std::optional<ReportedAction> executed;
    ShadowStep seen;
    if (step > 0) {
      seen.executed = Action{.discrete = step % 3, .continuous = {}};
      executed = int64_t{step % 3};
    }
    const auto served = agent_.Act(step, ObservationAt(step), 0.5, executed);
    ASSERT_TRUE(served.ok()) << served.status();
    seen.step = step;
    seen.observation = ObservationAt(step);
    seen.reward = 0.5;
    seen.target_return = agent_.session().target_return;
    seen.served = **served;
    const auto answer = shadow_.Act(seen);
    ASSERT_TRUE(answer.ok()) << answer.status();
    EXPECT_EQ((*answer)->counts, (*served)->counts) << step;
  }
}

TEST_F(ShadowSessionTest, AnEpisodeWithAHoleIsLostUntilTheNext) {
  ASSERT_TRUE(shadow_.Act(Serve(agent_)).ok());
  Serve(agent_);  // the shadow misses this step
  EXPECT_EQ(shadow_.Act(Serve(agent_)).status().code(), absl::StatusCode::kFailedPrecondition);
  ASSERT_TRUE(agent_.EndEpisode({}).ok());
  Serve(agent_);  // the shadow misses the first step of the second episode
  EXPECT_EQ(shadow_.Act(Serve(agent_)).status().code(), absl::StatusCode::kFailedPrecondition);
  ASSERT_TRUE(agent_.EndEpisode({}).ok());
  EXPECT_TRUE(shadow_.Act(Serve(agent_)).ok());
}

}  // namespace
}  // namespace spikeserve
