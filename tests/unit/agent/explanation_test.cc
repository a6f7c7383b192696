#include "core/agent/explanation.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <numeric>
#include <string>

#include "core/action/action_head.h"
#include "core/engine/factory/engine_factory.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::Eq;

constexpr int64_t kSteps = 12;  // more than the history holds

struct Variant {
  std::string name;
  ModelConfig config;
};

void PrintTo(const Variant& variant, std::ostream* out) { *out << variant.name; }

std::vector<Variant> Variants() {
  std::vector<Variant> variants;
  for (const Mode mode : {Mode::kBaseline, Mode::kPos, Mode::kRoute, Mode::kFull, Mode::kDense}) {
    variants.push_back({std::string(ToString(mode)), SmallConfig()});
    variants.back().config.mode = mode;
  }
  variants.push_back({"concat", SmallConfig()});
  variants.back().config.merge = Merge::kConcat;
  variants.push_back({"window", SmallConfig()});
  variants.back().config.phase_clock = PhaseClock::kWindow;
  variants.push_back({"context_of_one", SmallConfig()});
  variants.back().config.context = 1;
  variants.push_back({"changes", SmallConfig()});
  variants.back().config.observation_changes = true;
  variants.push_back({"changes_in_a_context_of_one", SmallConfig()});
  variants.back().config.observation_changes = true;
  variants.back().config.context = 1;
  variants.push_back({"three_layers", SmallConfig()});
  variants.back().config.layers = 3;
  for (Variant variant : std::vector<Variant>(variants)) {
    if (variant.config.is_dense()) continue;
    variant.name += "_integer";
    variant.config.arithmetic = Arithmetic::kInteger;
    variants.push_back(variant);
  }
  return variants;
}

Counts CountsOf(const Trace& trace) {
  Counts counts;
  for (const PopulationTrace& population : trace.populations) {
    for (const auto& tick : population.spikes) {
      counts.spikes(population.stage) += std::accumulate(tick.begin(), tick.end(), uint64_t{0});
    }
  }
  return counts;
}

class ExplanationTest : public testing::TestWithParam<Variant> {
 protected:
  // Makes one decision and returns its explanation.
  Explanation MustExplain(AgentSession& agent, int64_t step) {
    EXPECT_TRUE(agent.Act(step, ObservationAt(step), RewardAt(step)).ok());
    auto explanation = Explain(served_->policy(), agent.session());
    EXPECT_TRUE(explanation.ok()) << explanation.status();
    return *std::move(explanation);
  }

  FakeClock clock_;
  std::shared_ptr<const ServedPolicy> served_ = Serve(GetParam().config, ActionSpace::Discrete(3));
  AgentSession agent_{served_, NewSession("id", SmallOptions()), &clock_};
};

TEST_P(ExplanationTest, RecomputesTheSpikesThatWereCountedAndWhatTheHeadSaw) {
  for (int64_t step = 0; step < kSteps; ++step) {
    const Explanation explanation = MustExplain(agent_, step);
    const Answer& answer = *agent_.session().last_answer;
    EXPECT_EQ(CountsOf(explanation.trace).spikes_by_stage, answer.counts.spikes_by_stage) << step;
    const ActionChoice choice =
        ChooseAction(served_->policy().weights.head, served_->policy().action_space,
                     explanation.readout, ActionSelection(), /*random=*/0);
    EXPECT_EQ(choice.logits, answer.logits) << step;
    EXPECT_EQ(choice.probabilities, answer.probabilities) << step;
  }
}

TEST_P(ExplanationTest, AttentionAndGatesAreShares) {
  const ModelConfig& config = GetParam().config;
  const int ticks = config.is_dense() ? 1 : config.ticks;
  for (int64_t step = 0; step < kSteps; ++step) {
    const Explanation explanation = MustExplain(agent_, step);
    ASSERT_EQ(explanation.trace.layers.size(), static_cast<size_t>(config.layers));
    for (int layer = 0; layer < config.layers; ++layer) {
      const LayerTrace& trace = explanation.trace.layers[static_cast<size_t>(layer)];
      // The keys are those of the last N timesteps, without a_t, which is not known yet.
      const int64_t band = std::min<int64_t>(step + 1, config.context);
      ASSERT_EQ(trace.keys.size(), static_cast<size_t>(3 * band - 1));
      EXPECT_THAT(trace.keys.front(), Eq(TokenName{TokenKind::kReturn, step + 1 - band}));
      EXPECT_THAT(trace.keys.back(), Eq(TokenName{TokenKind::kState, step}));
      ASSERT_EQ(trace.attention.size(),
                trace.keys.size() * static_cast<size_t>(ticks * config.heads));
      for (size_t row = 0; row < trace.attention.size(); row += trace.keys.size()) {
        const auto first = trace.attention.begin() + static_cast<std::ptrdiff_t>(row);
        EXPECT_NEAR(std::accumulate(first, first + std::ssize(trace.keys), 0.0), 1.0, 1e-5);
      }
      if (!config.has_routing()) {
        EXPECT_TRUE(trace.gated.empty());
        continue;
      }
      EXPECT_EQ(trace.gates.size(), trace.gated.size() * static_cast<size_t>(ticks * config.heads));
      // In integers, concatenated heads are multiplied by H after their gates.
      const bool scaled = config.merge == Merge::kConcat && !config.is_integer();
      const float share = scaled ? static_cast<float>(config.heads) : 1.0f;
      EXPECT_NEAR(std::accumulate(trace.gates.begin(), trace.gates.begin() + config.heads, 0.0f),
                  share, 1e-5);
      if (layer + 1 == config.layers) {
        EXPECT_THAT(trace.gated, ElementsAre(TokenName{TokenKind::kState, step}));
      }
    }
  }
}

// Timesteps before the history do not influence the explanation.
TEST_P(ExplanationTest, TheHistoryHoldsEverything) {
  const auto first = std::max<int64_t>(0, kSteps - HistorySize(GetParam().config));
  for (int64_t step = 0; step < kSteps; ++step) MustExplain(agent_, step);
  const Session& session = agent_.session();
  const auto whole = Explain(served_->policy(), session);
  ASSERT_TRUE(whole.ok());
  ASSERT_EQ(static_cast<int64_t>(session.history.size()), kSteps - first);

  // Computes the same decision with an engine that keeps the whole episode.
  AgentSession replay(served_, NewSession("id", SmallOptions()), &clock_);
  PrefixContext prefix(0);
  std::vector<float> action(static_cast<size_t>(served_->policy().action_space.size()));
  for (int64_t step = 0; step < kSteps; ++step) {
    ASSERT_TRUE(replay.Act(step, ObservationAt(step), RewardAt(step)).ok());
    const History& history = replay.session().history;
    const Timestep timestep = history.at(history.size() - 1);
    prefix.AppendReturnAndState(served_->policy(), timestep.return_to_go, timestep.observation);
    if (step + 1 == kSteps) break;
    served_->policy().action_space.Encode(timestep.action, absl::MakeSpan(action));
    prefix.AppendAction(action);
  }
  Engine::Output output;
  Trace trace;
  TraceDecision(served_->policy(), prefix, &output, &trace);
  ASSERT_EQ(trace.populations.size(), whole->trace.populations.size());
  for (size_t i = 0; i < trace.populations.size(); ++i) {
    EXPECT_EQ(trace.populations[i].spikes, whole->trace.populations[i].spikes);
    EXPECT_EQ(trace.populations[i].token, whole->trace.populations[i].token);
  }
  for (size_t i = 0; i < trace.layers.size(); ++i) {
    EXPECT_EQ(trace.layers[i].attention, whole->trace.layers[i].attention);
    EXPECT_EQ(trace.layers[i].gated, whole->trace.layers[i].gated);
    EXPECT_EQ(trace.layers[i].gates, whole->trace.layers[i].gates);
  }
}

INSTANTIATE_TEST_SUITE_P(Variants, ExplanationTest, testing::ValuesIn(Variants()),
                         [](const auto& test) { return test.param.name; });

TEST(ExplainTest, ADecisionThatComesOutOtherwiseIsAnInternalError) {
  const auto served = Serve(SmallConfig(), ActionSpace::Discrete(2));
  FakeClock clock;
  AgentSession agent(served, NewSession("id", SmallOptions()), &clock);
  ASSERT_TRUE(agent.Act(0, ObservationAt(0), 0.0).ok());
  Session session = agent.session();
  ++session.last_answer->counts.spikes(Stage::kKey);
  EXPECT_EQ(Explain(served->policy(), session).status().code(), absl::StatusCode::kInternal);
}

TEST(ExplainTest, LogitsAreThoseOfTheHeadThatDecided) {
  const auto served = Serve(SmallConfig(), ActionSpace::Discrete(2));
  FakeClock clock;
  SessionOptions options = SmallOptions();
  options.action_selection.sample = true;
  options.learning = LearningOptions{.modulator = Modulator::kTarget, .learning_rate = 1.0};
  AgentSession agent(served, NewSession("id", options), &clock);
  Linear head = served->policy().weights.head;
  for (int64_t step = 0; step < 5; ++step) {
    ASSERT_TRUE(agent.Act(step, ObservationAt(step), RewardAt(step)).ok());
    const auto explanation = Explain(served->policy(), agent.session());
    ASSERT_TRUE(explanation.ok());
    const ActionChoice choice = ChooseAction(head, served->policy().action_space,
                                             explanation->readout, options.action_selection, 0);
    EXPECT_EQ(choice.logits, agent.session().last_answer->logits) << step;
    head = HeadWith(served->policy(), agent.session().learner->head_delta);
  }
  EXPECT_GT(agent.HeadDrift(), 0.0);
}

}  // namespace
}  // namespace spikeserve
