#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <string>

#include "core/action/action_head.h"
#include "core/action/action_space.h"

namespace spikeserve {
namespace {

using ::testing::Each;
using ::testing::ElementsAre;
using ::testing::FloatEq;
using ::testing::FloatNear;
using ::testing::Pointwise;

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
constexpr float kLargest = std::numeric_limits<float>::max();

Action Continuous(std::vector<float> values) {
  return {.discrete = 0, .continuous = std::move(values)};
}

Action Index(int index) { return {.discrete = index, .continuous = {}}; }

TEST(ActionSpace, DiscreteIsOneHot) {
  const ActionSpace space = ActionSpace::Discrete(3);
  EXPECT_TRUE(space.is_discrete());
  EXPECT_EQ(space.size(), 3);
  std::vector<float> encoded(3, 7.0f);
  space.Encode(Index(1), absl::MakeSpan(encoded));
  EXPECT_THAT(encoded, ElementsAre(0.0f, 1.0f, 0.0f));
}

TEST(ActionSpace, BoxMapsItsBoundsToPlusMinusOne) {
  const ActionSpace space = ActionSpace::Box({-2.0f, 0.0f, 1.0f}, {2.0f, 10.0f, 3.0f});
  EXPECT_FALSE(space.is_discrete());
  EXPECT_EQ(space.size(), 3);
  std::vector<float> encoded(3);
  space.Encode(Continuous({-2.0f, 10.0f, 1.5f}), absl::MakeSpan(encoded));
  EXPECT_THAT(encoded, ElementsAre(-1.0f, 1.0f, -0.5f));
  EXPECT_THAT(space.FromUnit(encoded), ElementsAre(-2.0f, 10.0f, 1.5f));
}

TEST(ActionSpace, FromUnitClampsToTheBounds) {
  const ActionSpace space = ActionSpace::Box({-2.0f, 0.0f}, {2.0f, 10.0f});
  EXPECT_THAT(space.FromUnit({-1.5f, 2.0f}), ElementsAre(-2.0f, 10.0f));
}

TEST(ActionSpace, TheWidestBoundsDoNotOverflow) {
  const ActionSpace space = ActionSpace::Box({-kLargest}, {kLargest});
  ASSERT_TRUE(space.Validate().ok());
  std::vector<float> encoded(1);
  space.Encode(Continuous({kLargest}), absl::MakeSpan(encoded));
  EXPECT_THAT(encoded, ElementsAre(1.0f));
  EXPECT_THAT(space.FromUnit({-1.0f}), ElementsAre(-kLargest));
}

TEST(ActionSpace, ContainsNamesWhatIsWrong) {
  const ActionSpace discrete = ActionSpace::Discrete(2);
  EXPECT_TRUE(discrete.Contains(Index(1)).ok());
  EXPECT_EQ(discrete.Contains(Index(2)).message(),
            "action: expected an index from 0 to 1, received 2");
  EXPECT_EQ(discrete.Contains(Index(-1)).code(), absl::StatusCode::kInvalidArgument);

  const ActionSpace box = ActionSpace::Box({-2.0f}, {2.0f});
  EXPECT_TRUE(box.Contains(Continuous({2.0f})).ok());
  EXPECT_EQ(box.Contains(Continuous({})).message(), "action: expected 1 values, received 0");
  EXPECT_EQ(box.Contains(Continuous({2.5f})).message(),
            "action[0]: expected -2 to 2, received 2.5");
  EXPECT_EQ(box.Contains(Continuous({kNan})).message(),
            "action[0]: expected -2 to 2, received nan");
}

// Returns a head that computes z = (r0 + r1, 2 r1 + 0.5, r0).
Linear Head() {
  Linear head = {Tensor::Zeros({3, 2}), Tensor::Zeros({3})};
  head.weight.values = {1.0f, 1.0f, 0.0f, 2.0f, 1.0f, 0.0f};
  head.bias.values = {0.0f, 0.5f, 0.0f};
  return head;
}

TEST(ActionHeadTest, GreedyTakesTheFirstMaximum) {
  const ActionSpace space = ActionSpace::Discrete(3);
  EXPECT_EQ(ChooseAction(Head(), space, {0.0f, 1.0f}, {}, 0).action.discrete, 1);
  EXPECT_EQ(ChooseAction(Head(), space, {1.0f, 0.0f}, {}, 0).action.discrete, 0)
      << "logits 0 and 2 are equal";
}

TEST(ActionHeadTest, ProbabilitiesAreTheSoftmaxOfTheLogits) {
  const ActionChoice choice = ChooseAction(Head(), ActionSpace::Discrete(3), {0.5f, 0.25f}, {}, 0);
  EXPECT_THAT(choice.logits, ElementsAre(0.75f, 1.0f, 0.5f));
  const float sum = std::exp(0.75f) + std::exp(1.0f) + std::exp(0.5f);
  EXPECT_THAT(choice.probabilities,
              Pointwise(FloatNear(1e-6f),
                        {std::exp(0.75f) / sum, std::exp(1.0f) / sum, std::exp(0.5f) / sum}));
}

TEST(ActionHeadTest, SamplesWithTheProbabilitiesItReports) {
  const ActionSelection selection = {.sample = true, .temperature = 2.0f};
  std::vector<float> counts(3, 0.0f);
  ActionChoice choice;
  constexpr int kDraws = 20000;
  for (uint64_t draw = 0; draw < kDraws; ++draw) {
    choice = ChooseAction(Head(), ActionSpace::Discrete(3), {1.0f, 1.0f}, selection, draw);
    counts[choice.action.discrete] += 1.0f / kDraws;
  }
  EXPECT_NEAR(choice.probabilities[1] / choice.probabilities[0], std::exp(0.25f), 1e-5)
      << "temperature 2";
  EXPECT_THAT(counts, Pointwise(FloatNear(0.015f), choice.probabilities));
}

TEST(ActionHeadTest, TheSameKeyDrawsTheSameAction) {
  const ActionSelection selection = {.sample = true, .temperature = 1.0f};
  const ActionSpace box = ActionSpace::Box({-2, -2, -2}, {2, 2, 2});
  const auto first = ChooseAction(Head(), box, {0.5f, 0.25f}, selection, 99).action;
  EXPECT_EQ(ChooseAction(Head(), box, {0.5f, 0.25f}, selection, 99).action, first);
  EXPECT_NE(ChooseAction(Head(), box, {0.5f, 0.25f}, selection, 98).action, first);
}

TEST(ActionHeadTest, BoxActionsAreTanhWithinTheBounds) {
  const ActionSpace box = ActionSpace::Box({-2, 0, -1}, {2, 4, 1});
  const ActionChoice choice = ChooseAction(Head(), box, {0.5f, 0.25f}, {}, 0);
  EXPECT_THAT(choice.action.continuous,
              Pointwise(FloatNear(1e-5f),
                        {2 * std::tanh(0.75f), 2 + 2 * std::tanh(1.0f), std::tanh(0.5f)}));
  EXPECT_TRUE(choice.probabilities.empty());
  const ActionChoice wild = ChooseAction(Head(), box, {1000.0f, 1000.0f}, {}, 0);
  EXPECT_TRUE(box.Contains(wild.action).ok());
}

}  // namespace
}  // namespace spikeserve
