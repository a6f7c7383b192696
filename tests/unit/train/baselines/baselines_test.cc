// Tests of the baselines: inputs, fits and errors.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/math/counter_random.h"
#include "train/baselines/comparison.h"
#include "train/baselines/verdict.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

float Draw(uint64_t a, uint64_t b) { return 2.0f * UniformFloat(RandomBits({a, b})) - 1.0f; }

// Returns episodes whose action is a function of the position and of the hidden velocity. The label
// is exact from the second step on.
Dataset HiddenVelocity(bool discrete) {
  Dataset dataset = {
      .environment = "Hidden-v0",
      .observation_size = 1,
      .action_space = discrete ? ActionSpace::Discrete(2) : ActionSpace::Box({-2.0f}, {2.0f}),
      .recipe = {},
      .episodes = {}};
  for (uint64_t i = 0; i < 60; ++i) {
    Episode episode = {
        .actor = "expert", .seed = i, .observations = {}, .actions = {}, .rewards = {}};
    float position = Draw(i, 1000), velocity = 0.0f;
    for (uint64_t t = 0; t <= 40; ++t) {
      episode.observations.push_back(position);
      if (t == 40) break;
      const float wanted = -0.5f * position - 8.0f * velocity;
      episode.actions.push_back(discrete ? Action{.discrete = wanted > 0.0f, .continuous = {}}
                                         : Action{.continuous = {wanted}});
      episode.rewards.push_back(0.0);
      velocity = 0.8f * velocity + 0.02f * Draw(i, t);
      position += velocity;
    }
    dataset.episodes.push_back(std::move(episode));
  }
  return dataset;
}

TEST(FrameInputTest, HoldsTheNewestObservationAndTheChangesBeforeIt) {
  FrameInput frames(1);
  const auto push = [&](float value) {
    const Eigen::VectorXf input = frames.Push({&value, 1});
    return std::vector<float>(input.begin(), input.end());
  };
  EXPECT_THAT(push(1.0f), ElementsAre(1.0f, 0.0f, 0.0f, 0.0f));
  EXPECT_THAT(push(3.0f), ElementsAre(3.0f, 2.0f, 0.0f, 0.0f));
  EXPECT_THAT(push(6.0f), ElementsAre(6.0f, 3.0f, 2.0f, 0.0f));
  EXPECT_THAT(push(6.5f), ElementsAre(6.5f, 0.5f, 3.0f, 2.0f));
  EXPECT_THAT(push(6.5f), ElementsAre(6.5f, 0.0f, 0.5f, 3.0f));
}

TEST(BaselineTest, TwoObservationsShowAVelocity) {
  for (const bool discrete : {false, true}) {
    const EpisodeSource source(HiddenVelocity(discrete));
    const ActionSpace& space = source.dataset().action_space;
    const BaselineData data = *ReadBaselineData(source, 0.1);
    EXPECT_EQ(data.held_out.rows(), 6 * 40);
    EXPECT_TRUE(NeedsChanges(space, data.training));
    const auto mlp = [&](int frames) {
      return FitMlp(space, data.training, data.held_out, frames);
    };
    for (const auto& fit : {FitLine(space, data.training, 1), mlp(1)}) {
      EXPECT_GT(ErrorOf(space, fit.Outputs(data.held_out.inputs), data.held_out).mean, 0.003);
    }
    for (const auto& fit :
         {FitLine(space, data.training, 2), mlp(2), FitLine(space, data.training, 4), mlp(4)}) {
      EXPECT_LT(ErrorOf(space, fit.Outputs(data.held_out.inputs), data.held_out).mean,
                discrete ? 0.1 : 0.0005)
          << fit.Name();
    }
  }
}

TEST(BaselineTest, APerceptronShowsAVelocityThatALineDoesNot) {
  Dataset dataset = HiddenVelocity(/*discrete=*/false);
  for (Episode& episode : dataset.episodes) {
    float before = episode.observations[0];
    for (size_t t = 0; t < episode.actions.size(); ++t) {
      const float change = 60.0f * (episode.observations[t] - before);
      before = episode.observations[t];
      episode.actions[t].continuous[0] = std::cos(change * change);
    }
  }
  const EpisodeSource source(std::move(dataset));
  const ActionSpace& space = source.dataset().action_space;
  const BaselineData data = *ReadBaselineData(source, 0.1);
  const auto error_of = [&](int frames) {
    const Baseline line = FitLine(space, data.training, frames);
    return ErrorOf(space, line.Outputs(data.held_out.inputs), data.held_out).mean;
  };
  EXPECT_GT(error_of(2), 0.95 * error_of(1));
  EXPECT_TRUE(NeedsChanges(space, data.training));
}

TEST(BaselineTest, NothingIsGainedWhereOneObservationIsEnough) {
  Dataset dataset = HiddenVelocity(/*discrete=*/false);
  for (Episode& episode : dataset.episodes) {
    for (size_t t = 0; t < episode.actions.size(); ++t) {
      episode.actions[t].continuous[0] = std::sin(episode.observations[t]);
    }
  }
  const EpisodeSource source(std::move(dataset));
  EXPECT_FALSE(
      NeedsChanges(source.dataset().action_space, ReadBaselineData(source, 0.1)->training));
}

TEST(ImitationErrorTest, MeansByElementAndEpisode) {
  StepTable table;
  table.begins = {0, 1, 3};
  table.targets = RowMajorMatrix<float>::Zero(3, 2);
  table.weights = Eigen::VectorXf::Ones(3);
  table.weights[2] = 2.0f;
  RowMajorMatrix<float> outputs(3, 2);
  outputs << 0.5f, 0.0f, 1.0f, 0.0f, 0.0f, 1.0f;
  const ActionSpace box = ActionSpace::Box({-1.0f, -1.0f}, {1.0f, 1.0f});
  const ImitationError error = ErrorOf(box, outputs, table);
  EXPECT_DOUBLE_EQ(error.explained, 0.0);  // targets of 0 leave nothing to explain
  EXPECT_NEAR(error.mean, (0.125 + 0.5 + 2 * 0.5) / 4.0, 1e-9);
  EXPECT_THAT(error.elements, ElementsAre(1.25 / 4.0, 0.5));
  EXPECT_THAT(error.episodes, ElementsAre(0.125, 0.5));
  table.targets << 1.0f, 0.0f, 0.0f, 1.0f, 0.0f, 1.0f;
  const ImitationError wrong = ErrorOf(ActionSpace::Discrete(2), outputs, table);
  EXPECT_THAT(wrong.episodes, ElementsAre(0.0, 1.0 / 3.0));
  // The best constant action is the second, which is wrong in the first step; the outputs are wrong
  // in the second.
  EXPECT_DOUBLE_EQ(wrong.explained, 0.0);
  const MeanDifference difference = Compare(error, wrong);
  EXPECT_NEAR(difference.mean, (0.125 + 0.5 - 1.0 / 3.0) / 2.0, 1e-9);
  EXPECT_TRUE(difference.is_significant());
  EXPECT_FALSE(Compare(wrong, error).is_significant());
}

TEST(BaselineTest, LargeObservationsAreRefused) {
  Dataset dataset = HiddenVelocity(false);
  dataset.observation_size = 200;
  dataset.episodes.resize(1);
  dataset.episodes[0].observations.assign(41 * 200, 0.0f);
  EXPECT_EQ(ReadBaselineData(EpisodeSource(dataset), 0.1).status().message(),
            "observations: expected at most 128 numbers to fit baselines, received 200");
}

// An error on three episodes that explains `share` of two elements.
ImitationError Explaining(double share) {
  const double error = 1.0 - share;
  return {.mean = error,
          .elements = {error, error},
          .episodes = {error, error + 0.001, error - 0.001},
          .explained = share,
          .explained_elements = {share + 0.1, share - 0.1}};
}

BaselineComparison Comparison(double policy, double baseline) {
  BaselineComparison comparison;
  comparison.policy = Explaining(policy);
  comparison.baselines.emplace_back().error = Explaining(baseline);
  return comparison;
}

TEST(ComparisonTest, WarnsOfABaselineThatReturnsMoreOnSeveralStarts) {
  BaselineComparison comparison = Comparison(0.9, 0.9);
  const auto warnings = [&](std::vector<double> policy, std::vector<double> baseline) {
    comparison.policy_returns = std::move(policy);
    comparison.baselines[0].returns = std::move(baseline);
    return Warnings(comparison);
  };
  EXPECT_THAT(warnings({}, {}), IsEmpty());
  EXPECT_THAT(warnings({-119.33}, {-118.3}), IsEmpty());  // any two policies differ on one start
  // The gains 1 and 3 have the standard error 1, with the divisor n - 1.
  EXPECT_THAT(warnings({10, 20}, {11, 23}), IsEmpty());
  EXPECT_THAT(warnings({10, 20, 30}, {12, 23, 34}),
              ElementsAre("line on 1 frame returns more than the policy: 23.00 (by 3.00 ± 0.58)"));
}

PolicyVerdict JudgeShares(double policy, double baseline,
                          std::optional<double> fall = std::nullopt) {
  return Judge(Comparison(policy, baseline), {"hip", "knee"}, fall);
}

TEST(VerdictTest, ComparesTheShareExplainedWithWhatTheDataTeach) {
  EXPECT_EQ(JudgeShares(0.9, 0.92).grade, Grade::kGood);
  EXPECT_EQ(JudgeShares(0.8, 0.9).grade, Grade::kWeak);
  EXPECT_EQ(JudgeShares(0.4, 0.4).grade, Grade::kWeak);
  EXPECT_EQ(JudgeShares(0.4, 0.9).grade, Grade::kBad);
  EXPECT_EQ(JudgeShares(0.2, 0.2).grade, Grade::kBad);
  EXPECT_EQ(JudgeShares(std::nan(""), 0.9).grade, Grade::kBad);
  EXPECT_THAT(JudgeShares(0.9, 0.92).advice, IsEmpty());
  EXPECT_EQ(
      ToText(JudgeShares(0.8, 0.9)),
      "verdict: weak: it explains 80 % of the actions of held-out steps (hip 90 %, knee 70 %), "
      "the best baseline (line on 1 frame) 90 %\n"
      "try: more iterations (--iterations) or a larger policy (--hidden_size), because the "
      "data teach more than it has learned\n");
}

TEST(VerdictTest, ALossThatStillFallsIsUndertrained) {
  const PolicyVerdict verdict = JudgeShares(0.9, 0.9, 0.07);
  EXPECT_EQ(verdict.grade, Grade::kWeak);
  EXPECT_THAT(verdict.reason, HasSubstr("undertrained: the validation loss still fell by 7 %"));
  EXPECT_THAT(verdict.advice, ElementsAre("more iterations (--iterations)"));
  EXPECT_EQ(JudgeShares(0.9, 0.9, 0.02).grade, Grade::kGood);
  EXPECT_EQ(LossFall({}), std::nullopt);
  EXPECT_EQ(LossFall({{95, 1.0}, {100, 0.5}}), std::nullopt);
  EXPECT_DOUBLE_EQ(*LossFall({{50, 2.0}, {90, 1.0}, {100, 0.75}}), 0.25);
}

TEST(VerdictTest, RequiresAGrade) {
  EXPECT_TRUE(CheckGrade(JudgeShares(0.2, 0.2), Grade::kBad).ok());
  EXPECT_TRUE(CheckGrade(JudgeShares(0.9, 0.9), Grade::kGood).ok());
  EXPECT_THAT(
      std::string(CheckGrade(JudgeShares(0.4, 0.4), Grade::kGood).message()),
      HasSubstr("--require: expected a verdict of good or better, received weak: it explains"));
  const PolicyVerdict unmeasured = Judge(std::nullopt, {}, std::nullopt);
  EXPECT_EQ(unmeasured.grade, Grade::kWeak);
  EXPECT_THAT(unmeasured.reason, HasSubstr("was not measured"));
}

TEST(VerdictTest, ElementsHaveTheNamesOfTheData) {
  Dataset dataset;
  dataset.action_space = ActionSpace::Box({-1.0f, -1.0f}, {1.0f, 1.0f});
  EXPECT_THAT(ActionNames(dataset), ElementsAre("0", "1"));
  dataset.recipe["action_names"] = {"hip", "knee"};
  EXPECT_THAT(ActionNames(dataset), ElementsAre("hip", "knee"));
  dataset.recipe["action_names"] = "[\"hip\", \"knee\"]";
  EXPECT_THAT(ActionNames(dataset), ElementsAre("hip", "knee"));
  dataset.recipe["action_names"] = "[\"hip\"]";
  EXPECT_THAT(ActionNames(dataset), ElementsAre("0", "1"));
  dataset.action_space = ActionSpace::Discrete(2);
  EXPECT_THAT(ActionNames(dataset), IsEmpty());
}

}  // namespace
}  // namespace spikeserve
