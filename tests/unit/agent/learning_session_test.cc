// Tests of sessions that learn: the behaviour that the session adds to the rules, which have their
// own tests.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>
#include <ostream>

#include "core/agent/agent_session.h"
#include "core/journal/session_bytes.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;
using Json = nlohmann::json;

struct LearningCase {
  std::string name;
  ActionSpace action_space;
  LearningOptions learning;
};

void PrintTo(const LearningCase& test, std::ostream* out) { *out << test.name; }

std::vector<LearningCase> LearningCases() {
  const ActionSpace discrete = ActionSpace::Discrete(3);
  const ActionSpace box = ActionSpace::Box({-2.0f, 0.0f}, {2.0f, 1.0f});
  std::vector<LearningCase> cases;
  for (const auto& [rule, rule_name] : EnumNames(Rule())) {
    for (const Modulator modulator : {Modulator::kTarget, Modulator::kRealized}) {
      for (const Scope scope : {Scope::kSession, Scope::kFleet}) {
        const LearningOptions learning = {
            .scope = scope, .rule = rule, .modulator = modulator, .learning_rate = 0.05};
        const std::string name = std::string(rule_name) +
                                 (modulator == Modulator::kTarget ? "Target" : "Realized") +
                                 (scope == Scope::kFleet ? "Fleet" : "Session");
        cases.push_back({name + "Discrete", discrete, learning});
        cases.push_back({name + "Box", box, learning});
      }
    }
  }
  return cases;
}

class LearningSessionTest : public ::testing::TestWithParam<LearningCase> {
 protected:
  // Returns an agent with a policy of its own, and therefore a fleet head of its own.
  AgentSession NewAgentElsewhere() {
    served_ = Serve(SmallConfig(), GetParam().action_space);
    return NewAgent();
  }

  AgentSession NewAgent(bool learns = true) {
    SessionOptions options = SmallOptions();
    options.action_selection = {.sample = true, .temperature = 0.7f};
    if (learns) options.learning = GetParam().learning;
    return AgentSession(served_, NewSession("id", std::move(options)), &clock_);
  }

  // Plays the steps [from, to) of an episode.
  void Play(AgentSession& agent, int64_t from, int64_t to) {
    for (int64_t t = from; t < to; ++t) {
      ASSERT_TRUE(agent.Act(t, ObservationAt(t), RewardAt(t)).ok());
    }
  }

  void End(AgentSession& agent) {
    ASSERT_TRUE(agent.EndEpisode({.reward = 2.0, .terminated = true, .target_return = {}}).ok());
  }

  // Returns the value without the times at which operators taught.
  static Session Timeless(const AgentSession& agent) {
    Session session = agent.session();
    for (CorrectionRun& run : session.learner->runs.runs) run.began = run.ended = 0.0;
    return session;
  }

  FakeClock clock_;
  std::shared_ptr<const ServedPolicy> served_ = Serve(SmallConfig(), GetParam().action_space);
};

// A session that is restored or loses its context between a decision and the report of what was
// executed continues as one that did neither.
TEST_P(LearningSessionTest, ExecutedActionsAreLearnedBitForBitAfterARestart) {
  const ActionSpace& space = served_->policy().action_space;
  const auto fleet = GetParam().learning.scope == Scope::kFleet;
  const bool corrects = GetParam().learning.rule == Rule::kCorrections;
  AgentSession steady = NewAgent();
  AgentSession answered = NewAgent();
  AgentSession moved = fleet ? NewAgentElsewhere() : NewAgent();
  const std::vector<float> values = {0.5f, 0.25f};
  for (int64_t t = 0; t < 15; ++t) {
    std::optional<ReportedAction> executed;
    if (t % 2 == 1 && space.is_discrete()) executed = t % 3;
    if (t % 2 == 1 && !space.is_discrete()) executed = absl::MakeConstSpan(values);
    if (executed.has_value() && corrects) {
      executed->source.kind = static_cast<int>(SourceKind::kOperator);
    }
    ASSERT_TRUE(answered.Act(t, ObservationAt(t), RewardAt(t)).ok());
    const auto expected = steady.Act(t, ObservationAt(t), RewardAt(t), executed);
    auto restored = ParseSession(SerializeSession(moved.session()));
    ASSERT_TRUE(restored.ok()) << restored.status();
    moved = AgentSession(served_, *std::move(restored), &clock_);
    const auto actual = moved.Act(t, ObservationAt(t), RewardAt(t), executed);
    ASSERT_TRUE(expected.ok() && actual.ok()) << expected.status();
    ASSERT_EQ(**actual, **expected) << t;
    if (t % 3 == 0) steady.AppendPendingAction();
  }
  EXPECT_EQ(SerializeSession(Timeless(moved)), SerializeSession(Timeless(steady)));
  const bool changed = GetParam().learning.rule != Rule::kHebbian;
  const Learner& without = *answered.session().learner;
  const Learner& with = *steady.session().learner;
  if (changed) {
    const auto difference =
        corrects ? without.head_delta - with.head_delta : without.trace - with.trace;
    EXPECT_GT(difference.norm(), 0.0f);
  }
  EXPECT_EQ(with.updates > without.updates, corrects);
}

// Ends two agents' episodes alike, one with its reward and one with a verdict, and moves the latter
// to another server before.
TEST_P(LearningSessionTest, LateVerdictsTeachTheSameHeadBitForBit) {
  const LearningOptions& learning = GetParam().learning;
  if (learning.modulator == Modulator::kTarget || learning.rule == Rule::kCorrections) GTEST_SKIP();
  const ActionSpace& space = served_->policy().action_space;
  AgentSession in_time = NewAgent();
  if (learning.scope == Scope::kFleet) served_ = Serve(SmallConfig(), space);
  const auto late_served = served_;
  SessionOptions options = in_time.session().options;
  options.learning->verdict_seconds = 3600.0;
  AgentSession late(late_served, NewSession("id", std::move(options)), &clock_);
  const std::vector<float> values = {0.5f, 0.25f};
  const auto move = [&] {
    auto restored = ParseSession(SerializeSession(late.session()));
    ASSERT_TRUE(restored.ok()) << restored.status();
    late = AgentSession(late_served, *std::move(restored), &clock_);
  };
  for (int64_t episode = 0; episode < 4; ++episode) {
    for (int64_t t = 0; t < 9; ++t) {
      std::optional<ReportedAction> executed;
      if (t % 2 == 1 && space.is_discrete()) executed = t % 3;
      if (t % 2 == 1 && !space.is_discrete()) executed = absl::MakeConstSpan(values);
      const auto expected = in_time.Act(t, ObservationAt(t), 0.0, executed);
      const auto actual = late.Act(t, ObservationAt(t), 0.0, executed);
      ASSERT_TRUE(expected.ok() && actual.ok()) << actual.status();
      ASSERT_EQ(**actual, **expected) << episode << " " << t;
      if (t == 4) move();
    }
    const double reward = 2.0 + static_cast<double>(episode);
    const bool terminated = episode % 2 == 0;
    const auto expected = in_time.EndEpisode({.reward = reward, .terminated = terminated});
    const auto ended = late.EndEpisode({.reward = 0.0, .terminated = terminated});
    ASSERT_TRUE(expected.ok() && ended.ok()) << ended.status();
    EXPECT_TRUE(ended->awaits_verdict);
    EXPECT_FALSE(ended->learning.has_value());
    move();
    const Amendment amendment = {.episode = episode, .id = "a", .digest = "d", .reward = reward};
    const auto verdict = late.Amend(amendment);
    ASSERT_TRUE(verdict.ok()) << verdict.status();
    EXPECT_EQ(verdict->episode_return, expected->episode_return);
    EXPECT_EQ(verdict->learning->updates, expected->learning->updates);
    EXPECT_EQ(late.HeadDelta(), in_time.HeadDelta());
    EXPECT_EQ(late.session().learner->returns, in_time.session().learner->returns);
    move();
    EXPECT_EQ(late.Amend(amendment)->episode_return, expected->episode_return);  // learns once
    EXPECT_EQ(late.HeadDelta(), in_time.HeadDelta());
  }
  EXPECT_GT(late.HeadDrift(), 0.0);
}

TEST_P(LearningSessionTest, OthersOfThePolicyAreUntouched) {
  AgentSession alone = NewAgent(/*learns=*/false);
  AgentSession frozen = NewAgent(/*learns=*/false);
  AgentSession learning = NewAgent();
  for (int episode = 0; episode < 2; ++episode) {
    Play(learning, 0, 12);
    End(learning);
    for (int64_t t = 0; t < 12; ++t) {
      EXPECT_EQ(**frozen.Act(t, ObservationAt(t), RewardAt(t)),
                **alone.Act(t, ObservationAt(t), RewardAt(t)));
    }
    End(frozen);
    End(alone);
  }
  const bool without_operator = GetParam().learning.rule != Rule::kCorrections;
  EXPECT_EQ(learning.HeadDrift() > 0.0, without_operator);
  EXPECT_EQ(frozen.HeadDrift(), 0.0);
  EXPECT_FALSE(frozen.session().learner.has_value());
}

INSTANTIATE_TEST_SUITE_P(Rules, LearningSessionTest, ::testing::ValuesIn(LearningCases()),
                         [](const auto& test) { return test.param.name; });

// Returns the bytes of a session that learns, with one value replaced.
std::string EditedLearner(const std::string& pointer, const Json& value) {
  const auto served = Serve(SmallConfig(), ActionSpace::Discrete(2));
  FakeClock clock;
  SessionOptions options = SmallOptions();
  options.learning = LearningOptions{.modulator = Modulator::kRealized};
  const AgentSession agent(served, NewSession("id", options), &clock);
  Json json = Json::from_cbor(SerializeSession(agent.session()));
  json[1][Json::json_pointer(pointer)] = value;
  const std::vector<uint8_t> bytes = Json::to_cbor(json);
  return std::string(bytes.begin(), bytes.end());
}

TEST(ParseLearningSessionTest, WrongFieldsAreNamed) {
  const auto refuse = [](const std::string& pointer, const Json& value,
                         const std::string& message) {
    const auto parsed = ParseSession(EditedLearner(pointer, value));
    EXPECT_EQ(parsed.status().code(), absl::StatusCode::kInvalidArgument);
    EXPECT_THAT(std::string(parsed.status().message()), HasSubstr(message));
  };
  refuse("/1/7/0", "universe", "session.options.learning.scope: expected session or fleet");
  refuse("/1/7/1", "sarsa",
         "session.options.learning.rule: expected policy_gradient, hebbian, hebbian_action or "
         "corrections");
  refuse("/1/7", nullptr, "session.learner: expected one if and only if");
  refuse("/15/1/1", -1.0, "session.learner.returns.variance: expected at least 0");
  refuse("/15/2/2", Json::array(), "session.learner.guard.good: expected 32 numbers, received 0");
  refuse("/15/2/0", std::vector<double>(20, 1.5),
         "session.learner.guard.returns: expected fewer than 20, received 20");
  refuse("/15/3", Json::array(), "session.learner.trace: expected 32 numbers, received 0");
  refuse("/15/5", Json::array(), "session.learner.trace_sum: expected 32 numbers, received 0");
  refuse("/15/0/5", "x", "session.learner.head_delta[5]: expected a finite");
}

}  // namespace
}  // namespace spikeserve
