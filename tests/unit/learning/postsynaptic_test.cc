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

const ActionSpace kDiscrete = ActionSpace::Discrete(2);
const ActionSpace kBox = ActionSpace::Box({-1, -1}, {1, 1});

std::vector<float> Postsynaptic(Rule rule, const ActionSpace& space, const ActionChoice& choice) {
  std::vector<float> post = {9.0f};  // is overwritten
  PostsynapticActivity(rule, space, choice, &post);
  return post;
}

TEST(PostsynapticActivityTest, HebbianIsTheHeadsOutput) {
  const ActionChoice discrete = ChooseAction(kHead, kDiscrete, std::vector<float>{0.5f}, {}, 0);
  EXPECT_EQ(Postsynaptic(Rule::kHebbian, kDiscrete, discrete), discrete.probabilities);
  const float p = 1.0f / (1.0f + std::exp(-1.0f));
  EXPECT_THAT(discrete.probabilities, ElementsAre(FloatNear(p, 1e-6f), FloatNear(1 - p, 1e-6f)));

  // Noise changes the action but not y.
  const ActionChoice box =
      ChooseAction(kHead, kBox, std::vector<float>{0.5f}, {.sample = true, .temperature = 3.0f}, 7);
  const float y = std::tanh(0.5f);
  EXPECT_THAT(Postsynaptic(Rule::kHebbian, kBox, box),
              ElementsAre(FloatNear(y, 1e-6f), FloatNear(-y, 1e-6f)));
}

TEST(PostsynapticActivityTest, PolicyGradientIsTheScoreOfADiscreteAction) {
  const ActionSelection sampled = {.sample = true, .temperature = 2.0f};
  for (uint64_t random = 0; random < 8; ++random) {
    const ActionChoice choice =
        ChooseAction(kHead, kDiscrete, std::vector<float>{0.5f}, sampled, random);
    const float p = 1.0f / (1.0f + std::exp(-0.5f));  // of action 0, at temperature 2
    const float y = choice.action.discrete == 0 ? 1 - p : -p;
    EXPECT_THAT(Postsynaptic(Rule::kPolicyGradient, kDiscrete, choice),
                ElementsAre(FloatNear(y, 1e-6f), FloatNear(-y, 1e-6f)));
  }
}

TEST(PostsynapticActivityTest, PolicyGradientIsTheStandardisedNoiseOfABoxAction) {
  const ActionChoice choice = ChooseAction(kHead, kBox, std::vector<float>{0.5f},
                                           {.sample = true, .temperature = 0.25f}, 7);
  const auto score = [&](size_t i, float z) {
    return (std::atanh(choice.action.continuous[i]) - z) / 0.25f;
  };
  const std::vector<float> y = Postsynaptic(Rule::kPolicyGradient, kBox, choice);
  EXPECT_THAT(y, ElementsAre(FloatNear(score(0, 0.5f), 1e-4f), FloatNear(score(1, -0.5f), 1e-4f)));
  EXPECT_NE(y[0], 0.0f);
}

TEST(PostsynapticActivityTest, HebbianActionIsTheActionThatWasDrawn) {
  const ActionSelection sampled = {.sample = true, .temperature = 2.0f};
  for (uint64_t random = 0; random < 8; ++random) {
    const ActionChoice discrete =
        ChooseAction(kHead, kDiscrete, std::vector<float>{0.5f}, sampled, random);
    std::vector<float> spikes = {0.0f, 0.0f};
    spikes[static_cast<size_t>(discrete.action.discrete)] = 1.0f;
    EXPECT_EQ(Postsynaptic(Rule::kHebbianAction, kDiscrete, discrete), spikes);
  }

  const ActionSpace wide = ActionSpace::Box({-2, 0}, {2, 4});
  const ActionChoice box = ChooseAction(kHead, wide, std::vector<float>{0.5f}, sampled, 7);
  EXPECT_THAT(Postsynaptic(Rule::kHebbianAction, wide, box),
              ElementsAre(FloatNear(std::tanh(0.5f + 2.0f * box.noise[0]), 1e-6f),
                          FloatNear(std::tanh(-0.5f + 2.0f * box.noise[1]), 1e-6f)));
}

TEST(ReplaceActionTest, HebbianActionBecomesTheExecutedAction) {
  const std::vector<float> logits = {0.5f, -0.5f};
  const auto discrete = [](int index) { return Action{.discrete = index, .continuous = {}}; };
  const auto continuous = [](float first, float second) {
    return Action{.discrete = 0, .continuous = {first, second}};
  };
  std::vector<float> spikes = {1.0f, 0.0f};
  ReplaceAction(Rule::kHebbianAction, kDiscrete, logits, 1.0f, discrete(0), discrete(1),
                absl::MakeSpan(spikes));
  EXPECT_THAT(spikes, ElementsAre(0.0f, 1.0f));

  // The first element was executed as answered.
  std::vector<float> values = {0.25f, 0.75f};
  ReplaceAction(Rule::kHebbianAction, ActionSpace::Box({-2, 0}, {2, 4}), logits, 1.0f,
                continuous(0.5f, 3.5f), continuous(0.5f, 4.0f), absl::MakeSpan(values));
  EXPECT_THAT(values, ElementsAre(0.25f, 1.0f));
}

}  // namespace
}  // namespace spikeserve
