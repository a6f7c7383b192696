// Tests that the streaming engine equals the reference engine bit for bit in spikes by stage,
// operations and readout: for random policies of many shapes in all arithmetics, over episodes
// much longer than the context, on every SIMD target of this processor.

#include <gtest/gtest.h>

#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/action/action_head.h"
#include "core/engine/factory/engine_factory.h"
#include "core/engine/prefix_engine.h"
#include "core/math/counter_random.h"
#include "core/model/policy.h"
#include "core/model/policy_file.h"
#include "core/quantize/quantize_integer.h"
#include "tests/support/simd_targets.h"
#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

struct Shape {
  std::string name;
  ModelConfig config;
  int observation_size = 4;
  ActionSpace action_space = ActionSpace::Discrete(2);
  int steps = 40;
  float spread = 1.0f;             // scales the observations
  float first_ffn_bias = 0.2f;     // of the FFN's coder in the first layer
  float largest_residual = 16.0f;  // see IntegerOptions
  float update = 1.0f;             // scales the maps that add to the residual stream
};

void PrintTo(const Shape& shape, std::ostream* out) { *out << shape.name; }

// An episode of synthetic inputs, the same for every engine.
class Episode {
 public:
  Episode(const Policy& policy, float spread) : policy_(policy), spread_(spread) {}

  std::vector<float> Observation(int step) const {
    std::vector<float> observation(policy_.observation_size());
    for (size_t i = 0; i < observation.size(); ++i) observation[i] = Draw(step, i);
    return observation;
  }
  float ReturnToGo(int step) const { return 10.0f * Draw(step, 100); }
  std::vector<float> EncodedAction(int step) const {
    std::vector<float> encoded(policy_.action_space.size(), 0.0f);
    if (policy_.action_space.is_discrete()) {
      encoded[RandomBits({2, static_cast<uint64_t>(step)}) % encoded.size()] = 1.0f;
    } else {
      for (size_t i = 0; i < encoded.size(); ++i)
        encoded[i] = Draw(step, 200 + i) / (2.0f * spread_);
    }
    return encoded;
  }

 private:
  float Draw(int step, size_t what) const {
    return spread_ *
           (4.0f * UniformFloat(RandomBits({1, static_cast<uint64_t>(step), what})) - 2.0f);
  }

  const Policy& policy_;
  float spread_;
};

std::vector<Engine::Output> Play(const Engine& engine, const Shape& shape, int first_step = 0) {
  const Episode episode(engine.policy(), shape.spread);
  const auto context = engine.NewContext(first_step);
  std::vector<Engine::Output> outputs(shape.steps - first_step);
  for (int step = first_step; step < shape.steps; ++step) {
    engine.Decide(*context, episode.ReturnToGo(step), episode.Observation(step),
                  &outputs[step - first_step]);
    engine.AppendAction(*context, episode.EncodedAction(step));
  }
  return outputs;
}

void ExpectEqual(const Engine::Output& actual, const Engine::Output& expected, int step) {
  for (int stage = 0; stage < kStages; ++stage) {
    EXPECT_EQ(actual.counts.spikes_by_stage[stage], expected.counts.spikes_by_stage[stage])
        << ToString(static_cast<Stage>(stage)) << " at step " << step;
  }
  const auto expect_equal = [&](const char* what, auto member) {
    EXPECT_EQ(actual.counts.*member, expected.counts.*member) << what << " at step " << step;
  };
  expect_equal("accumulates", &Counts::accumulates);
  expect_equal("multiply_accumulates", &Counts::multiply_accumulates);
  expect_equal("attention_products", &Counts::attention_products);
  expect_equal("integer_multiply_accumulates", &Counts::integer_multiply_accumulates);
  expect_equal("wide_multiply_accumulates", &Counts::wide_multiply_accumulates);
  expect_equal("driven_neurons", &Counts::driven_neurons);
  expect_equal("membrane_updates", &Counts::membrane_updates);
  expect_equal("membrane_leaks", &Counts::membrane_leaks);
  expect_equal("attention_scalings", &Counts::attention_scalings);
  expect_equal("weight_bytes", &Counts::weight_bytes);
  expect_equal("attention_bytes", &Counts::attention_bytes);
  expect_equal("coder_gains", &Counts::coder_gains);
  expect_equal("layer_norm_elements", &Counts::layer_norm_elements);
  expect_equal("softmax_terms", &Counts::softmax_terms);
  expect_equal("gate_products", &Counts::gate_products);
  EXPECT_EQ(actual.readout, expected.readout) << "step " << step;
}

// Returns SmallConfig() with `hidden_size` neurons in `heads` heads. The routing and FFN layers
// have sizes that are not multiples of a SIMD vector's length.
ModelConfig ConfigOf(int hidden_size, int heads) {
  ModelConfig config = SmallConfig();
  config.hidden_size = hidden_size;
  config.heads = heads;
  config.routing_hidden_size = 6;
  config.ffn_size = 2 * hidden_size + 5;
  return config;
}

std::vector<Shape> Float32Shapes() {
  std::vector<Shape> shapes;
  const auto add = [&shapes](std::string name, const ModelConfig& config) -> Shape& {
    shapes.push_back({.name = std::move(name), .config = config});
    return shapes.back();
  };
  for (const Mode mode : {Mode::kBaseline, Mode::kPos, Mode::kRoute, Mode::kFull, Mode::kDense}) {
    for (const Merge merge : {Merge::kSum, Merge::kConcat}) {
      const auto name = std::string(ToString(mode)) + "_" + std::string(ToString(merge));
      ModelConfig& config = add(name, ConfigOf(32, 4)).config;
      config.mode = mode;
      config.merge = merge;
    }
  }
  add("OneLayer", ConfigOf(16, 2)).config.layers = 1;
  add("ThreeLayers", ConfigOf(24, 3)).config.layers = 3;
  add("ContextOne", ConfigOf(16, 2)).config.context = 1;
  add("ManyTicks", ConfigOf(16, 2)).config.ticks = 37;
  ModelConfig& one_tick = add("OneTick", ConfigOf(16, 4)).config;
  one_tick.ticks = 1;
  one_tick.threshold = 0.3f;
  add("OneHead", ConfigOf(20, 1)).config.context = 6;
  add("OddHeads", ConfigOf(35, 5)).config.context = 7;
  add("WideHeads", ConfigOf(80, 2)).steps = 16;
  Shape& full_words = add("FullWordHeads", ConfigOf(64, 2));
  full_words.config.context = 12;
  full_words.steps = 30;
  Shape& long_context = add("LongContext", ConfigOf(16, 2));
  long_context.config.layers = 1;
  long_context.config.context = 23;
  long_context.steps = 60;
  add("Box", ConfigOf(32, 4)).action_space = ActionSpace::Box({-2.0f, 0.0f}, {2.0f, 1.0f});
  add("LoudInputs", ConfigOf(32, 4)).spread = 8.0f;
  add("OftenSilentFfn", ConfigOf(16, 2)).first_ffn_bias = -0.8f;
  add("SigmoidGate", ConfigOf(32, 4)).config.gate = Gate::kSigmoid;
  ModelConfig& sigmoid_concat = add("SigmoidGateConcat", ConfigOf(32, 4)).config;
  sigmoid_concat.gate = Gate::kSigmoid;
  sigmoid_concat.merge = Merge::kConcat;
  add("WindowClock", ConfigOf(32, 4)).config.phase_clock = PhaseClock::kWindow;
  for (const Mode mode : {Mode::kFull, Mode::kDense}) {
    ModelConfig& changes = add("Changes_" + std::string(ToString(mode)), ConfigOf(32, 4)).config;
    changes.mode = mode;
    changes.observation_changes = true;
  }
  for (const Mode mode : {Mode::kBaseline, Mode::kFull}) {
    for (const Merge merge : {Merge::kSum, Merge::kConcat}) {
      const auto name =
          absl::StrCat("NoNorms_", std::string(ToString(mode)), "_", std::string(ToString(merge)));
      ModelConfig& config = add(name, ConfigOf(35, 5)).config;
      config.mode = mode;
      config.merge = merge;
      config.norm = NormKind::kNone;
    }
  }
  // The residual stream of integers saturates.
  Shape& limits = add("NoNormsLoudInputs", ConfigOf(32, 4));
  limits.config.norm = NormKind::kNone;
  limits.spread = 8.0f;
  limits.largest_residual = 0.5f;
  limits.update = 16.0f;  // brings numbers back from the limits
  ModelConfig& newest = add("ChangesContextOne", ConfigOf(16, 2)).config;
  newest.observation_changes = true;
  newest.context = 1;
  ModelConfig& other_neuron = add("OtherNeuron", ConfigOf(32, 4)).config;
  other_neuron.ticks = 8;
  other_neuron.membrane_decay = 0.5f;
  other_neuron.threshold = 0.3f;
  return shapes;
}

// Returns the shapes that integer arithmetic has: those with rate coders, and its own variants.
std::vector<Shape> IntegerShapes() {
  std::vector<Shape> shapes;
  for (Shape& shape : Float32Shapes()) {
    shape.name += "_integer";
    shape.config.arithmetic = Arithmetic::kInteger;
    shapes.push_back(std::move(shape));
  }
  shapes.push_back({.name = "SlowLeak_integer", .config = ConfigOf(32, 4)});
  shapes.back().config.membrane_decay = 1.0f;
  shapes.back().config.arithmetic = Arithmetic::kInteger;
  // Files of former releases.
  for (const Mode mode : {Mode::kBaseline, Mode::kFull}) {
    shapes.push_back({.name = absl::StrCat("AllTicks_", std::string(ToString(mode)), "_integer"),
                      .config = ConfigOf(36, 3)});
    shapes.back().config.mode = mode;
    shapes.back().config.arithmetic = Arithmetic::kInteger;
    shapes.back().config.attention = AttentionTicks::kAllTicks;
  }
  shapes.push_back({.name = "Stripped_integer", .config = ConfigOf(64, 2)});
  shapes.back().config.mode = Mode::kBaseline;
  shapes.back().config.arithmetic = Arithmetic::kInteger;
  return shapes;
}

// Returns every shape in every arithmetic that its mode has.
std::vector<Shape> Shapes() {
  std::vector<Shape> shapes = Float32Shapes();
  for (Shape& shape : IntegerShapes()) shapes.push_back(std::move(shape));
  return shapes;
}

// Returns a random policy with increased weights, so that queries and keys fire and every path of
// attention is used. In a plain random policy they hardly fire.
Policy MakePolicy(const Shape& shape, uint64_t seed) {
  ModelConfig config = shape.config;
  config.arithmetic = Arithmetic::kFloat32;
  Policy policy = RandomPolicy(config, shape.observation_size, shape.action_space, seed);
  for (LayerWeights& layer : policy.weights.layers) {
    for (Linear* linear : {&layer.query, &layer.key, &layer.value, &layer.ffn_hidden}) {
      for (float& weight : linear->weight.values) weight *= 3.0f;
    }
    for (Linear* linear : {&layer.attention_output, &layer.ffn_output}) {
      for (float& weight : linear->weight.values) weight *= shape.update;
    }
    for (size_t h = 1; h < layer.scale.values.size(); h += 2) layer.scale.values[h] *= -1.5f;
    layer.ffn_hidden.weight.values[3] = 0.0f;  // a zero weight does not count as a synapse
  }
  std::vector<float>& change_std = policy.weights.observation_change_std.values;
  for (size_t i = 0; i < change_std.size(); ++i) change_std[i] = 0.5f + static_cast<float>(i);
  std::vector<float>& ffn_bias = policy.weights.layers[0].ffn_coder.bias.values;
  ffn_bias.assign(ffn_bias.size(), shape.first_ffn_bias);
  if (shape.config.is_integer()) {
    return *QuantizeToInteger(policy,
                              {.largest_input = 8.0f, .largest_residual = shape.largest_residual});
  }
  return policy;
}

class EngineParityTest : public testing::TestWithParam<Shape> {};

TEST_P(EngineParityTest, StreamingEqualsReferenceOnEveryTarget) {
  const Shape& shape = GetParam();
  for (const uint64_t seed : {1, 2}) {
    const auto policy = std::make_shared<const Policy>(MakePolicy(shape, seed));
    ASSERT_TRUE(policy->Validate().ok()) << policy->Validate();
    const std::vector<Engine::Output> expected = Play(*MakeReferenceEngine(policy), shape);
    const std::unique_ptr<Engine> streaming = MakeEngine(policy);
    SCOPED_TRACE("seed " + std::to_string(seed));
    OnEverySimdTarget([&] {
      const std::vector<Engine::Output> actual = Play(*streaming, shape);
      for (int step = 0; step < shape.steps; ++step)
        ExpectEqual(actual[step], expected[step], step);
    });
    if (HasFailure()) return;
  }
}

TEST_P(EngineParityTest, ContextRebuiltFromHistoryGoesOnAlike) {
  const Shape& shape = GetParam();
  const auto policy = std::make_shared<const Policy>(MakePolicy(shape, 3));
  const std::unique_ptr<Engine> engine = MakeEngine(policy);
  const std::vector<Engine::Output> expected = Play(*engine, shape);
  const int history = HistorySize(shape.config);
  for (int resumed = 1; resumed < shape.steps; resumed += 7) {
    const int first = std::max(0, resumed - history);
    const std::vector<Engine::Output> actual = Play(*engine, shape, first);
    for (int step = resumed; step < shape.steps; ++step)
      ExpectEqual(actual[step - first], expected[step], step);
  }
}

// The contexts start at different timesteps, so that no two of them are equal.
TEST_P(EngineParityTest, DecisionsMadeTogetherEqualThoseMadeAlone) {
  constexpr int kContexts = 5;
  const Shape& shape = GetParam();
  const auto policy = std::make_shared<const Policy>(MakePolicy(shape, 4));
  const std::unique_ptr<Engine> engine = MakeEngine(policy);
  const Episode episode(*policy, shape.spread);
  std::vector<std::vector<Engine::Output>> expected;
  std::vector<std::unique_ptr<Engine::Context>> contexts;
  for (int i = 0; i < kContexts; ++i) {
    expected.push_back(Play(*engine, shape, i));
    contexts.push_back(engine->NewContext(i));
  }
  for (int t = 0; t < shape.steps - kContexts; ++t) {
    std::vector<std::vector<float>> inputs;
    std::vector<Engine::Output> outputs(kContexts);
    std::vector<Engine::Decision> decisions;
    std::vector<Engine::TakenAction> actions;
    for (int i = 0; i < kContexts; ++i) inputs.push_back(episode.Observation(i + t));
    for (int i = 0; i < kContexts; ++i) inputs.push_back(episode.EncodedAction(i + t));
    for (int i = 0; i < kContexts; ++i) {
      decisions.push_back({contexts[i].get(), episode.ReturnToGo(i + t), inputs[i], &outputs[i]});
      actions.push_back({contexts[i].get(), inputs[kContexts + i]});
    }
    engine->DecideTogether(decisions);
    engine->AppendActionsTogether(actions);
    for (int i = 0; i < kContexts; ++i) ExpectEqual(outputs[i], expected[i][t], i + t);
  }
}

TEST_P(EngineParityTest, CompactEngineDecidesAlikeAndRestoresItsPolicy) {
  const Shape& shape = GetParam();
  const auto policy = std::make_shared<const Policy>(MakePolicy(shape, 5));
  const std::unique_ptr<Engine> engine = MakeEngine(*policy);
  EXPECT_EQ(*FormatPolicyFile(engine->CompletePolicy()), *FormatPolicyFile(*policy));
  if (!shape.config.is_dense()) {
    const Weights& weights = engine->policy().weights;
    EXPECT_TRUE(weights.embed_state.linear.weight.values.empty());
    EXPECT_TRUE(weights.layers[0].integer.query.weight.values.empty());
  }
  const std::vector<Engine::Output> expected = Play(*MakeEngine(policy), shape);
  const std::vector<Engine::Output> actual = Play(*engine, shape);
  for (int step = 0; step < shape.steps; ++step) ExpectEqual(actual[step], expected[step], step);
}

TEST_P(EngineParityTest, PopulationsAreAlive) {
  const Shape& shape = GetParam();
  if (shape.config.is_dense()) return;
  Counts total;
  const auto policy = std::make_shared<const Policy>(MakePolicy(shape, 1));
  for (const Engine::Output& output : Play(*MakeEngine(policy), shape)) total += output.counts;
  for (int i = 0; i < kStages; ++i) {
    if (static_cast<Stage>(i) == Stage::kPhase && !shape.config.has_phase()) continue;
    EXPECT_GT(total.spikes_by_stage[i], 0u) << ToString(static_cast<Stage>(i));
  }
}

std::vector<float> Logits(const Engine& engine, const Engine::Output& output) {
  const Policy& policy = engine.policy();
  return ChooseAction(policy.weights.head, policy.action_space, output.readout, {}, 0).logits;
}

// Returns the deviation of the logits of the integers from those in float32, as a share of the
// deviation of these from their mean.
double LogitError(Shape shape, uint64_t seed) {
  shape.config.arithmetic = Arithmetic::kFloat32;
  const auto exact = MakeEngine(MakePolicy(shape, seed));
  shape.config.arithmetic = Arithmetic::kInteger;
  const auto rounded = MakeEngine(MakePolicy(shape, seed));
  const std::vector<Engine::Output> expected = Play(*exact, shape), actual = Play(*rounded, shape);
  double error = 0.0, sum = 0.0, squares = 0.0;
  for (int step = 0; step < shape.steps; ++step) {
    const float logit = Logits(*exact, expected[step])[0];
    error += std::pow(Logits(*rounded, actual[step])[0] - logit, 2.0);
    sum += logit;
    squares += std::pow(logit, 2.0);
  }
  return std::sqrt(error / (squares - sum * sum / shape.steps));
}

// Weights of 8 bits move a few spikes, and one layer moves no spikes of the next ones.
TEST(IntegerParityTest, LogitsDifferFromFloat32ByRoundingAlone) {
  for (Shape& shape : Float32Shapes()) {
    const bool saturates = shape.spread > 1.0f || shape.config.norm == NormKind::kNone;
    if (shape.config.is_dense() || saturates) continue;
    shape.steps = 60;
    shape.config.layers = 1;
    double total = 0.0;
    for (const uint64_t seed : {1, 2, 3}) total += LogitError(shape, seed) / 3.0;
    EXPECT_LT(total, 0.2) << shape.name;
  }
}

INSTANTIATE_TEST_SUITE_P(Shapes, EngineParityTest, testing::ValuesIn(Shapes()),
                         [](const auto& test) { return test.param.name; });

class EngineParityAtPaperSizeTest : public testing::TestWithParam<Arithmetic> {};

TEST_P(EngineParityAtPaperSizeTest, StreamingEqualsReference) {
  const Shape shape = {.name = "paper", .config = {.arithmetic = GetParam()}, .steps = 26};
  const auto policy = std::make_shared<const Policy>(MakePolicy(shape, 1));
  const std::vector<Engine::Output> expected = Play(*MakeReferenceEngine(policy), shape);
  const std::vector<Engine::Output> actual = Play(*MakeEngine(policy), shape);
  for (int step = 0; step < shape.steps; ++step) ExpectEqual(actual[step], expected[step], step);
}

INSTANTIATE_TEST_SUITE_P(Arithmetics, EngineParityAtPaperSizeTest,
                         testing::Values(Arithmetic::kFloat32, Arithmetic::kInteger),
                         [](const auto& test) { return std::string(ToString(test.param)); });

// Observations that float32 holds become infinite when they are standardised, or the scores of a
// gate do by large weights. The residual stream then has infinities and NaN, and no neuron fires
// for NaN, also behind the last whole vector.
TEST(EngineParityBeyondFloat32Test, StreamingEqualsReferenceOnEveryTarget) {
  for (const auto& [norm, by_gates] :
       {std::pair(NormKind::kLayer, false), {NormKind::kLayer, true}, {NormKind::kNone, false}}) {
    Shape shape = {.name = "beyond", .config = ConfigOf(35, 5), .steps = 12};
    shape.config.norm = norm;
    if (!by_gates) shape.spread = 1e37f;
    Policy random = MakePolicy(shape, 1);
    if (!by_gates) random.weights.observation_std.values.assign(4, 0.01f);
    if (by_gates) {
      LayerWeights& layer = random.weights.layers[1];
      layer.routing_hidden.weight.values.assign(6 * 35, 1.0f);
      layer.routing_hidden.bias.values.assign(6, 0.0f);  // so that gates of silent heads are finite
      layer.routing_gate.weight.values.assign(5 * 6, 3e38f);
    }
    const auto policy = std::make_shared<const Policy>(std::move(random));
    const std::vector<Engine::Output> expected = Play(*MakeReferenceEngine(policy), shape);
    const std::unique_ptr<Engine> streaming = MakeEngine(policy);
    OnEverySimdTarget([&] {
      const std::vector<Engine::Output> actual = Play(*streaming, shape);
      for (int step = 0; step < shape.steps; ++step)
        ExpectEqual(actual[step], expected[step], step);
    });
  }
}

// Returns the reference engine's decision at `step` of the episode, from the steps that it depends
// on.
Engine::Output ReferenceDecision(const Policy& policy, const Shape& shape, int step) {
  const Episode episode(policy, shape.spread);
  const int first = std::max(0, step + 1 - HistorySize(policy.config));
  PrefixContext prefix(first);
  for (int t = first; t <= step; ++t) {
    if (t > first) prefix.AppendAction(episode.EncodedAction(t - 1));
    prefix.AppendReturnAndState(policy, episode.ReturnToGo(t), episode.Observation(t));
  }
  Engine::Output output;
  Trace trace;
  TraceDecision(policy, prefix, &output, &trace);
  return output;
}

// The ring of a long context stores its keys in rows, clears expired tokens many at a time, and has
// more slots than the band has tokens. The episode fills it more than once.
TEST(EngineParityInLongContextTest, StreamingEqualsReferenceOnEveryTarget) {
  Shape shape = {.name = "LongRing", .config = ConfigOf(16, 2), .steps = 1100};
  shape.config.layers = 1;
  shape.config.context = 345;
  const auto policy = std::make_shared<const Policy>(MakePolicy(shape, 1));
  const std::unique_ptr<Engine> streaming = MakeEngine(policy);
  const std::vector<int> steps = {1, 40, 344, 345, 346, 500, 511, 512, 513, 800, 1023, 1024, 1099};
  std::vector<Engine::Output> expected;
  for (const int step : steps) expected.push_back(ReferenceDecision(*policy, shape, step));
  OnEverySimdTarget([&] {
    const std::vector<Engine::Output> actual = Play(*streaming, shape);
    for (size_t i = 0; i < steps.size(); ++i) ExpectEqual(actual[steps[i]], expected[i], steps[i]);
  });
}

}  // namespace
}  // namespace spikeserve
