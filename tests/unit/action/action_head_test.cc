#include "core/action/action_head.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>

namespace spikeserve {
namespace {

using testing::Each;
using testing::ElementsAre;
using testing::FloatEq;
using testing::FloatNear;
using testing::Pointwise;

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
