// Tests of the verdict at the end of a training.
#include "train/baselines/verdict.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <optional>
#include <string>

namespace spikeserve {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;

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

Verdict JudgeShares(double policy, double baseline, std::optional<double> fall = std::nullopt) {
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
  const Verdict verdict = JudgeShares(0.9, 0.9, 0.07);
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
  const Verdict unmeasured = Judge(std::nullopt, {}, std::nullopt);
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
