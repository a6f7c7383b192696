#include "core/learning/postsynaptic.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "core/action/action_head.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::FloatEq;
using ::testing::FloatNear;

// A head that computes z = (r, -r) from a readout of one rate r.
const Linear kHead = {.weight = {.shape = {2, 1}, .values = {1.0f, -1.0f}},
                      .bias = {.shape = {2}, .values = {0.0f, 0.0f}}};

std::vector<float> Postsynaptic(Rule rule, const ActionChoice& choice) {
  std::vector<float> post = {9.0f};  // is overwritten
  PostsynapticActivity(rule, choice, &post);
  return post;
}

TEST(PostsynapticActivityTest, HebbianIsTheHeadsOutput) {
  const ActionChoice discrete =
      ChooseAction(kHead, ActionSpace::Discrete(2), std::vector<float>{0.5f}, {}, 0);
  EXPECT_EQ(Postsynaptic(Rule::kHebbian, discrete), discrete.probabilities);
  const float p = 1.0f / (1.0f + std::exp(-1.0f));
  EXPECT_THAT(discrete.probabilities, ElementsAre(FloatNear(p, 1e-6f), FloatNear(1 - p, 1e-6f)));

  // Noise changes the action but not y.
  const ActionChoice box =
      ChooseAction(kHead, ActionSpace::Box({-1, -1}, {1, 1}), std::vector<float>{0.5f},
                   {.sample = true, .temperature = 3.0f}, 7);
  const float y = std::tanh(0.5f);
  EXPECT_THAT(Postsynaptic(Rule::kHebbian, box),
              ElementsAre(FloatNear(y, 1e-6f), FloatNear(-y, 1e-6f)));
}

TEST(PostsynapticActivityTest, PolicyGradientIsTheScoreOfADiscreteAction) {
  const ActionSelection sampled = {.sample = true, .temperature = 2.0f};
  for (uint64_t random = 0; random < 8; ++random) {
    const ActionChoice choice =
        ChooseAction(kHead, ActionSpace::Discrete(2), std::vector<float>{0.5f}, sampled, random);
    const float p = 1.0f / (1.0f + std::exp(-0.5f));  // of action 0, at temperature 2
    const float y = choice.action.discrete == 0 ? 1 - p : -p;
    EXPECT_THAT(Postsynaptic(Rule::kPolicyGradient, choice),
                ElementsAre(FloatNear(y, 1e-6f), FloatNear(-y, 1e-6f)));
  }
}

TEST(PostsynapticActivityTest, PolicyGradientIsTheStandardisedNoiseOfABoxAction) {
  const ActionChoice choice =
      ChooseAction(kHead, ActionSpace::Box({-1, -1}, {1, 1}), std::vector<float>{0.5f},
                   {.sample = true, .temperature = 0.25f}, 7);
  const auto score = [&](size_t i, float z) {
    return (std::atanh(choice.action.continuous[i]) - z) / 0.25f;
  };
  const std::vector<float> y = Postsynaptic(Rule::kPolicyGradient, choice);
  EXPECT_THAT(y, ElementsAre(FloatNear(score(0, 0.5f), 1e-4f), FloatNear(score(1, -0.5f), 1e-4f)));
  EXPECT_NE(y[0], 0.0f);
}

}  // namespace
}  // namespace spikeserve
