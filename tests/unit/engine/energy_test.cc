#include "core/engine/energy.h"

#include <gtest/gtest.h>

#include "core/engine/account.h"
#include "core/engine/counts.h"
#include "core/engine/factory/engine_factory.h"
#include "core/engine/token_costs.h"
#include "core/quantize/quantize_integer.h"
#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

constexpr double kPico = 1e-12;

// Different numbers for every kind, so that no two can be exchanged unnoticed.
Counts SomeCounts() {
  Counts counts;
  counts.spikes(Stage::kCoder) = 70;
  counts.spikes(Stage::kPhase) = 10;
  counts.spikes(Stage::kReadout) = 20;
  counts.accumulates = 1000;
  counts.multiply_accumulates = 60;
  counts.integer_multiply_accumulates = 20;
  counts.attention_products = 500;
  counts.membrane_updates = 3000;
  counts.membrane_leaks = 2000;
  counts.driven_neurons = 250;
  counts.coder_gains = 100;
  counts.layer_norm_elements = 200;
  counts.softmax_terms = 300;
  counts.gate_products = 400;
  counts.weight_bytes = 800;
  counts.attention_bytes = 900;
  return counts;
}

ModelConfig Configured(Arithmetic arithmetic) {
  ModelConfig config = SmallConfig();
  config.arithmetic = arithmetic;
  return config;
}

TEST(EnergyTest, EveryModelPricesWhatItSays) {
  const Counts counts = SomeCounts();
  ModelConfig config = Configured(Arithmetic::kInteger);
  config.membrane_decay = 1.0f - 13.0f / 256.0f;
  ASSERT_EQ(config.ticks, 5);
  ASSERT_EQ(config.leak(), 13);
  const auto joules = [&](EnergyModel model) { return *EstimateEnergy(model, counts, config); };
  EXPECT_DOUBLE_EQ(joules(EnergyModel::kSpike5pj), 500 * kPico);
  EXPECT_DOUBLE_EQ(
      joules(EnergyModel::kHorowitz45nm),
      (0.9 * (1000 + 500) + 4.6 * (60 + 3000 + 100 + 400) + 14.7 * 200 + 9.2 * 300) * kPico);
  // A coder's element is looked up by 3 comparisons. A leak of 13 = 16 - 4 + 1 has 3 additions, and
  // one of the bias. Each sum of a membrane is limited, and an element of a norm twice.
  const double operations = 0.03 * 1000 + 0.23 * 20 + 4.6 * 40 + 0.1 * 3000 + 3 * 0.05 * 100 +
                            0.03 * 90 + 0.1 * 500 + 1.15 * 300 + 0.23 * 400 + 3.05 * 200 +
                            0.1 * (3000 + 2000 + 2 * 200) + 0.2 * 2000;
  EXPECT_NEAR(joules(EnergyModel::kInt45nm), operations * kPico, 1e-9 * kPico);
  // Every memory of this small policy costs 1.25 pJ a byte.
  const double bytes = 800 + 4 * 250 + 2 * 3 * 100 + 900;
  EXPECT_NEAR(joules(EnergyModel::kIntSram45nm), (operations + 1.25 * bytes) * kPico, 1e-9 * kPico);
  EXPECT_EQ(DefaultEnergy(counts, config), joules(EnergyModel::kHorowitz45nm));
}

// Every element that a norm would get is coded once, so the account counts limits by the coders.
TEST(EnergyTest, EveryElementOfTheStreamIsCodedOnce) {
  ModelConfig config;
  for (config.layers = 1; config.layers < 4; ++config.layers) {
    for (const TokenKind kind : {TokenKind::kAction, TokenKind::kReturn, TokenKind::kState}) {
      Counts counts;
      AddTokenCosts(config, kind, 60, &counts);
      EXPECT_EQ(counts.coder_gains, counts.layer_norm_elements);
    }
  }
}

// The three tokens of a decision at the paper's size, with a full window.
TEST(EnergyTest, ADecisionOfThePapersSizeUpdates55040Membranes) {
  const ModelConfig config;
  Counts counts;
  for (const TokenKind kind : {TokenKind::kAction, TokenKind::kReturn, TokenKind::kState}) {
    AddTokenCosts(config, kind, 60, &counts);
  }
  EXPECT_EQ(counts.membrane_updates, 55040u);
  // Layer 0 codes three tokens twice, layer 1 three once and the state again, then the readout.
  EXPECT_EQ(counts.coder_gains, 128u * (6 + 4 + 1));
  EXPECT_EQ(counts.layer_norm_elements, 128u * (3 + 2 * 4));
  EXPECT_EQ(counts.softmax_terms, 4u * 10 * 4 * (60 + 1));
  EXPECT_EQ(counts.gate_products, 4u * 10 * 128);
}

// A played dense policy skips zeros, but what depends on sizes alone is that of the twin.
TEST(EnergyTest, TheDenseBaselineIsWhatADensePolicyOfTheSameSizesDoesInAFullWindow) {
  const auto policy =
      std::make_shared<const Policy>(*QuantizeToInteger(SmallPolicy(SmallConfig(Mode::kDense))));
  const auto engine = MakeEngine(policy);
  const auto context = engine->NewContext();
  Engine::Output output;
  for (int step = 0; step < 6; ++step) {  // longer than the window of 4
    if (step > 0) engine->AppendAction(*context, {1.0f, 0.0f});
    engine->Decide(*context, 1.0f, {1.0f, 2.0f, -3.0f, 4.0f}, &output);
  }
  const Counts twin = DenseBaselineCounts(SmallConfig(), 4, 2);
  EXPECT_EQ(output.counts.layer_norm_elements, twin.layer_norm_elements);
  EXPECT_EQ(output.counts.softmax_terms, twin.softmax_terms);
  EXPECT_EQ(output.counts.weight_bytes, twin.weight_bytes);
  EXPECT_EQ(output.counts.attention_bytes, twin.attention_bytes);
  const auto skips_few = [](uint64_t count, uint64_t most) {
    EXPECT_LE(count, most);
    EXPECT_GT(count, most / 2);
  };
  skips_few(output.counts.multiply_accumulates, twin.multiply_accumulates);
  skips_few(output.counts.integer_multiply_accumulates, twin.integer_multiply_accumulates);
  skips_few(output.counts.wide_multiply_accumulates, twin.wide_multiply_accumulates);
  skips_few(output.counts.attention_products, twin.attention_products);
  skips_few(output.counts.attention_scalings, twin.attention_scalings);
}

// 853,120 multiply-accumulates and 60,416 products of attention.
TEST(EnergyTest, TheDenseBaselineAtThePapersSize) {
  const Counts twin = DenseBaselineCounts(ModelConfig(), 4, 2);
  EXPECT_EQ(twin.multiply_accumulates, 853'120u);
  EXPECT_EQ(twin.attention_products, 60'416u);
  EXPECT_EQ(twin.softmax_terms, 944u);
  EXPECT_EQ(twin.weight_bytes, 394'112u + 2 * 128 * 4);
}

TEST(CountsTest, AttentionProductsAreNoSynapticOperations) {
  Counts counts;
  counts.accumulates = 1000;
  counts.multiply_accumulates = 10;
  counts.attention_products = 100;
  EXPECT_EQ(counts.synaptic_operations(), 1010u);
}

// A model that is small enough to count by hand: every coder neuron fires at every tick, and no
// other neuron ever fires.
TEST(CountsTest, ADecisionBearsItsThreeTokens) {
  const ModelConfig config = SmallConfig(Mode::kBaseline);
  const auto d = static_cast<uint64_t>(config.hidden_size);
  const auto ffn = static_cast<uint64_t>(config.ffn_size);
  const uint64_t coder_spikes = d * static_cast<uint64_t>(config.ticks);
  Policy policy = SmallPolicy(config);
  for (TensorSlot& slot : TensorSlots(config, 4, 2, &policy.weights)) {
    const bool coder = slot.name.find("coder") != std::string::npos;
    const bool bias = slot.name.ends_with("bias");
    const bool weight = slot.name.ends_with("weight") && slot.floats()->shape.size() == 2;
    if (coder) slot.floats()->values.assign(slot.floats()->values.size(), bias ? 2.0f : 0.0f);
    if (weight) slot.floats()->values.assign(slot.floats()->values.size(), -0.5f);
  }
  const auto shared = std::make_shared<const Policy>(policy);
  for (const auto& engine : {MakeReferenceEngine(shared), MakeEngine(shared)}) {
    const auto context = engine->NewContext();
    Engine::Output output;
    engine->Decide(*context, 1.0f, {1.0f, 2.0f, 3.0f, 4.0f}, &output);
    // The tokens are G_0 and s_0. The last layer codes both, but its feed-forward part computes
    // only s_0.
    EXPECT_EQ(output.counts.spikes(Stage::kCoder), coder_spikes * 4);
    EXPECT_EQ(output.counts.spikes(Stage::kFfnIn), coder_spikes * 3);
    EXPECT_EQ(output.counts.spikes(Stage::kReadout), coder_spikes);
    EXPECT_EQ(output.counts.total_spikes(), coder_spikes * 8);
    // Layer 0 computes Q, K, V and FFN for both tokens; layer 1 computes K and V for both, Q and
    // FFN only for the state.
    EXPECT_EQ(output.counts.accumulates,
              coder_spikes * (2 * (3 * d + ffn) + 2 * (2 * d) + (d + ffn)));
    // The embeddings have d (1 + 4) and the head 2 d. The outputs of attention and FFN are zero,
    // because value and FFN neurons do not fire.
    EXPECT_EQ(output.counts.multiply_accumulates, d * (1 + 4) + 2 * d);
    EXPECT_EQ(output.counts.attention_products, 0u);
    // Membranes, gains and normalised elements do not depend on who fires.
    const auto ticks = static_cast<uint64_t>(config.ticks);
    const auto heads = static_cast<uint64_t>(config.heads);
    EXPECT_EQ(output.counts.membrane_updates,
              ticks * (2 * (5 * d + ffn) + 3 * d + (5 * d + ffn) + d));
    EXPECT_EQ(output.counts.coder_gains, 8 * d);
    EXPECT_EQ(output.counts.layer_norm_elements, 2 * d + 4 * d + 2 * d);
    // G_0 attends to one token, s_0 to two, in layer 1 again.
    EXPECT_EQ(output.counts.softmax_terms, ticks * heads * (1 + 2 + 2));
    EXPECT_EQ(output.counts.gate_products, 0u);

    engine->AppendAction(*context, {0.0f, 1.0f});
    engine->Decide(*context, 1.0f, {1.0f, 2.0f, 3.0f, 4.0f}, &output);
    // The token a_0 adds a coder and an FFN coder in layer 0, and a coder in layer 1.
    EXPECT_EQ(output.counts.total_spikes(), coder_spikes * (8 + 3));
    EXPECT_EQ(output.counts.accumulates,
              coder_spikes * (3 * (3 * d + ffn) + 3 * (2 * d) + (d + ffn)));
    EXPECT_EQ(output.counts.multiply_accumulates, d * (1 + 1 + 4) + 2 * d)
        << "a one-hot action has one nonzero input";
  }
}

}  // namespace
}  // namespace spikeserve
