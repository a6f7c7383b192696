#include "core/engine/counts.h"

#include <gtest/gtest.h>

#include "core/engine/factory/engine_factory.h"
#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

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
