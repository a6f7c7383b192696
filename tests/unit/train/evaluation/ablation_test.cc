// Tests that switch off each part of a policy and compare the readouts of the engine.
#include "train/evaluation/ablation.h"

#include <gtest/gtest.h>

#include <memory>
#include <vector>

#include "core/engine/factory/engine_factory.h"
#include "tests/support/small_config.h"

namespace spikeserve {
namespace {

// Returns a policy for observations of length 1, with increased weights and many ticks, so that
// every part influences the readout.
Policy MakePolicy(Mode mode = Mode::kFull) {
  ModelConfig config = SmallConfig(mode);
  config.ticks = 20;
  Policy policy = RandomPolicy(config, 1, ActionSpace::Discrete(2), 7);
  for (LayerWeights& layer : policy.weights.layers) {
    for (Linear* linear : {&layer.query, &layer.key, &layer.value, &layer.attention_output}) {
      for (float& weight : linear->weight.values) weight *= 8.0f;
    }
    for (float& weight : layer.routing_gate.weight.values) weight *= 8.0f;
  }
  return policy;
}

// Returns the readout of the last of four steps. `first` is the first observation, `shift` is the
// return-to-go of every step.
std::vector<float> Readouts(const Policy& policy, float first, float shift) {
  const auto engine = MakeEngine(std::make_shared<const Policy>(policy));
  const auto context = engine->NewContext();
  Engine::Output output;
  for (int t = 0; t < 4; ++t) {
    const std::vector<float> observation = {t == 0 ? first : 0.3f * static_cast<float>(t)};
    engine->Decide(*context, shift, observation, &output);
    engine->AppendAction(*context, std::vector<float>{1.0f, 0.0f});
  }
  return output.readout;
}

TEST(AblationTest, WithoutContextThePastIsForgotten) {
  Policy policy = MakePolicy();
  EXPECT_NE(Readouts(policy, -3.0f, 0.0f), Readouts(policy, 3.0f, 0.0f));
  ASSERT_TRUE(Ablate("context", &policy).ok());
  EXPECT_EQ(Readouts(policy, -3.0f, 0.0f), Readouts(policy, 3.0f, 0.0f));
}

TEST(AblationTest, WithoutReturnItIsNotHeard) {
  Policy policy = MakePolicy();
  EXPECT_NE(Readouts(policy, 0.0f, -2.0f), Readouts(policy, 0.0f, 2.0f));
  ASSERT_TRUE(Ablate("return", &policy).ok());
  EXPECT_EQ(Readouts(policy, 0.0f, -2.0f), Readouts(policy, 0.0f, 2.0f));
}

TEST(AblationTest, AttentionRoutingAndPhaseChangeWhatIsComputed) {
  for (const char* part : {"attention", "routing", "phase"}) {
    Policy policy = MakePolicy();
    const std::vector<float> before = Readouts(policy, 1.0f, 0.0f);
    ASSERT_TRUE(Ablate(part, &policy).ok());
    EXPECT_NE(Readouts(policy, 1.0f, 0.0f), before) << part;
    EXPECT_TRUE(policy.Validate().ok());
  }
}

TEST(AblationTest, WithoutPhaseTheClockIsNotHeard) {
  Policy policy = MakePolicy(), shifted = policy;
  for (float& phi : shifted.weights.phase_phi.values) phi += 1.5f;
  EXPECT_NE(Readouts(policy, 1.0f, 0.0f), Readouts(shifted, 1.0f, 0.0f));
  ASSERT_TRUE(Ablate("phase", &policy).ok());
  ASSERT_TRUE(Ablate("phase", &shifted).ok());
  EXPECT_EQ(Readouts(policy, 1.0f, 0.0f), Readouts(shifted, 1.0f, 0.0f));
}

TEST(AblationTest, WhatIsNotThereCannotBeSwitchedOff) {
  Policy baseline = MakePolicy(Mode::kBaseline), dense = MakePolicy(Mode::kDense);
  EXPECT_EQ(Ablate("phase", &baseline).message(),
            "ablate: a policy of mode baseline has no phase to switch off");
  EXPECT_EQ(Ablate("attention", &dense).message(),
            "ablate: a policy of mode dense has no attention to switch off");
  EXPECT_EQ(
      Ablate("head", &baseline).message(),
      "ablate: expected context, changes, attention, phase, routing or return, received 'head'");
}

}  // namespace
}  // namespace spikeserve
