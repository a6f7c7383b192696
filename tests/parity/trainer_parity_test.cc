// Tests that the trainer's torch model equals both engines, decision by decision, on random
// policies.
//
// Torch adds float32 numbers in another order than the engines. A membrane that is within rounding
// of the threshold may therefore fire on one side only, and all later results of that episode may
// differ. The test allows only this difference: at the first decision whose spikes differ, a
// membrane must be within kRounding of the threshold. Integer neurons add exactly, so with
// Arithmetic::kInteger none may. Comparison of an episode ends there, and in total at least
// kLeastCompared of all decisions must have been compared.

#include <gtest/gtest.h>
#include <torch/types.h>

#include <cmath>
#include <limits>
#include <memory>
#include <string>
#include <vector>

#include "core/action/action_head.h"
#include "core/engine/factory/engine_factory.h"
#include "core/math/counter_random.h"
#include "core/neuron/lif.h"
#include "tests/support/small_policy.h"
#include "train/model/torch_model.h"

namespace spikeserve {
namespace {

constexpr float kRounding = 1e-5f;  // of a membrane, for a threshold of 1
constexpr float kLogitTolerance = 1e-4f;
constexpr double kLeastCompared = 0.95;  // share of all decisions
constexpr int kSteps = 14;               // much longer than the context

struct Shape {
  std::string name;
  ModelConfig config;
  ActionSpace action_space = ActionSpace::Discrete(3);
  uint64_t policies = 3;
  Arithmetic arithmetic = Arithmetic::kFloat32;
};

void PrintTo(const Shape& shape, std::ostream* out) { *out << shape.name; }

ModelConfig FourHeads(Mode mode = Mode::kFull) {
  ModelConfig config = SmallConfig(mode);
  config.hidden_size = 32;
  config.heads = 4;
  config.ticks = 7;
  config.ffn_size = 70;
  return config;
}

std::vector<Shape> Shapes() {
  std::vector<Shape> shapes;
  for (const Mode mode : {Mode::kBaseline, Mode::kPos, Mode::kRoute, Mode::kFull, Mode::kDense}) {
    for (const Merge merge : {Merge::kSum, Merge::kConcat}) {
      ModelConfig config = FourHeads(mode);
      config.merge = merge;
      shapes.push_back({.name = std::string(ToString(mode)) + "_" + std::string(ToString(merge)),
                        .config = config});
    }
  }
  const auto add = [&shapes](const char* name, auto change) {
    Shape shape = {.name = name, .config = FourHeads()};
    change(shape);
    shapes.push_back(shape);
  };
  add("sigmoid", [](Shape& s) { s.config.gate = Gate::kSigmoid; });
  add("sigmoid_concat", [](Shape& s) {
    s.config.gate = Gate::kSigmoid;
    s.config.merge = Merge::kConcat;
  });
  add("window", [](Shape& s) { s.config.phase_clock = PhaseClock::kWindow; });
  add("three_layers", [](Shape& s) { s.config.layers = 3; });
  add("one_layer", [](Shape& s) { s.config.layers = 1; });
  add("odd_heads", [](Shape& s) {
    s.config.hidden_size = 35;
    s.config.heads = 5;
  });
  add("other_neuron", [](Shape& s) {
    s.config.membrane_decay = 0.7f;
    s.config.threshold = 0.5f;
  });
  add("box", [](Shape& s) { s.action_space = ActionSpace::Box({-2.0f, 0.0f}, {2.0f, 1.0f}); });
  add("no_norms", [](Shape& s) { s.config.norm = NormKind::kNone; });
  add("no_norms_concat", [](Shape& s) {
    s.config.norm = NormKind::kNone;
    s.config.mode = Mode::kBaseline;
    s.config.merge = Merge::kConcat;
  });
  add("changes", [](Shape& s) { s.config.observation_changes = true; });
  add("changes_dense", [](Shape& s) {
    s.config.mode = Mode::kDense;
    s.config.observation_changes = true;
  });
  add("papers_size", [](Shape& s) {
    s.config = ModelConfig{};
    s.policies = 1;
  });
  // The sums of ffn.output exceed the integers of float32.
  add("many_ticks", [](Shape& s) {
    s.config.ticks = 255;
    s.config.ffn_size = 600;
    s.policies = 1;
  });
  const std::vector<Shape> floats = shapes;
  for (Shape shape : floats) {
    if (shape.config.is_dense() || !shape.config.has_norms())
      continue;  // is not trained through the integers
    shape.name += "_integer";
    shape.arithmetic = Arithmetic::kInteger;
    shapes.push_back(shape);
  }
  return shapes;
}

// Returns a random policy with increased weights, because queries and keys of a plain one hardly
// fire, and with non-trivial scaling of observations and returns.
Policy MakePolicy(const Shape& shape, uint64_t seed) {
  Policy policy = RandomPolicy(shape.config, 4, shape.action_space, seed);
  for (LayerWeights& layer : policy.weights.layers) {
    for (Linear* linear : {&layer.query, &layer.key, &layer.value, &layer.ffn_hidden}) {
      for (float& weight : linear->weight.values) weight *= 2.5f;
    }
  }
  policy.weights.observation_mean.values = {0.1f, -0.2f, 0.3f, 0.0f};
  policy.weights.observation_std.values = {0.5f, 1.5f, 2.0f, 0.7f};
  if (shape.config.observation_changes) {
    policy.weights.observation_change_std.values = {0.3f, 2.0f, 1.0f, 0.6f};
  }
  policy.return_offset = 3.0f;
  policy.return_scale = 5.0f;
  return policy;
}

// Returns a synthetic episode as a clip of kSteps timesteps.
ClipTensors MakeEpisode(const Policy& policy, uint64_t seed) {
  const int64_t obs = policy.observation_size(), act = policy.action_space.size();
  ClipTensors clip = {.return_to_go = torch::empty({1, kSteps}),
                      .observations = torch::empty({1, kSteps, obs}),
                      .actions = torch::zeros({1, kSteps, act}),
                      .timesteps = torch::arange(kSteps).unsqueeze(0),
                      .previous = {}};
  const auto draw = [seed](int step, int64_t what) {
    return 4.0f * UniformFloat(RandomBits(
                      {seed, static_cast<uint64_t>(step), static_cast<uint64_t>(what)})) -
           2.0f;
  };
  for (int step = 0; step < kSteps; ++step) {
    clip.return_to_go[0][step] = 5.0f * draw(step, 100);
    for (int64_t i = 0; i < obs; ++i) clip.observations[0][step][i] = draw(step, i);
    for (int64_t i = 0; i < act; ++i) clip.actions[0][step][i] = draw(step, 200 + i) / 2.0f;
    if (!policy.action_space.is_discrete()) continue;
    clip.actions[0][step] = torch::one_hot(clip.actions[0][step].argmax(), act);
  }
  clip.previous = clip.observations.select(1, 0);
  return clip;
}

std::vector<float> ToVector(const torch::Tensor& tensor) {
  const torch::Tensor values = tensor.detach().contiguous();
  const float* data = values.data_ptr<float>();
  return {data, data + values.numel()};
}

// Returns the range of tokens of a population that decision t computes: those of a_{t-1}, G_t and
// s_t that the population has.
std::pair<int64_t, int64_t> TokensOf(int t, int64_t tokens) {
  if (tokens == kSteps) return {t, t + 1};
  return {std::max(0, 3 * t - 1), 3 * t + 2};
}

// The results of the torch model for one decision.
struct TorchDecision {
  std::array<uint64_t, kStages> spikes = {};
  // The smallest |V - V_th| of all neurons and ticks.
  float margin = std::numeric_limits<float>::infinity();
};

// Returns the smallest |V - V_th| of the population's neurons in the tokens [first, last).
float Margin(const Population& population, const Lif& neuron, int ticks, int64_t first,
             int64_t last) {
  if (!population.current.defined()) return std::numeric_limits<float>::infinity();
  const bool constant = population.current.dim() == 3;
  const torch::Tensor current =
      constant ? population.current.unsqueeze(0).expand({ticks, -1, -1, -1}) : population.current;
  const std::vector<float> input = ToVector(current.slice(2, first, last));
  const size_t neurons = input.size() / ticks;
  float margin = std::numeric_limits<float>::infinity();
  for (size_t i = 0; i < neurons; ++i) {
    float membrane = 0.0f;
    for (int tick = 0; tick < ticks; ++tick) {
      const float before_reset = neuron.decay * membrane + input[tick * neurons + i];
      margin = std::min(margin, std::abs(before_reset - neuron.threshold));
      neuron.Step(input[tick * neurons + i], membrane);
    }
  }
  return margin;
}

TorchDecision DecisionOf(const ModelOutput& output, const ModelConfig& config, int t) {
  TorchDecision decision;
  const Lif neuron = {config.membrane_decay, config.threshold};
  for (const Population& population : output.populations) {
    const auto [first, last] = TokensOf(t, population.spikes.size(2));
    decision.spikes[static_cast<size_t>(population.stage)] +=
        static_cast<uint64_t>(population.spikes.slice(2, first, last).sum().item<double>());
    decision.margin =
        std::min(decision.margin, Margin(population, neuron, config.ticks, first, last));
  }
  return decision;
}

// Plays the clip with an engine and compares its results with the torch model's. Returns the number
// of decisions before the first one whose spikes differ.
int CompareWithEngine(const Engine& engine, const ClipTensors& clip, const ModelOutput& output) {
  const Policy& policy = engine.policy();
  const auto context = engine.NewContext();
  Engine::Output decided;
  for (int t = 0; t < kSteps; ++t) {
    engine.Decide(*context, clip.return_to_go[0][t].item<float>(),
                  ToVector(clip.observations[0][t]), &decided);
    const TorchDecision expected = DecisionOf(output, policy.config, t);
    if (expected.spikes != decided.counts.spikes_by_stage) {
      EXPECT_LT(expected.margin, kRounding) << "spikes differ at decision " << t;
      return t;
    }
    const std::vector<float> readout = ToVector(output.readout[0][t]);
    const std::vector<float> logits = ToVector(output.logits[0][t]);
    const ActionChoice choice =
        ChooseAction(policy.weights.head, policy.action_space, decided.readout, {}, 0);
    for (size_t i = 0; i < readout.size(); ++i) {
      EXPECT_NEAR(decided.readout[i], readout[i], kLogitTolerance) << "decision " << t;
    }
    for (size_t i = 0; i < logits.size(); ++i) {
      EXPECT_NEAR(choice.logits[i], logits[i], kLogitTolerance) << "decision " << t;
    }
    engine.AppendAction(*context, ToVector(clip.actions[0][t]));
  }
  return kSteps;
}

class TrainerParityTest : public testing::TestWithParam<Shape> {};

TEST_P(TrainerParityTest, TorchAgreesWithBothEngines) {
  int compared = 0;
  for (uint64_t seed = 1; seed <= GetParam().policies; ++seed) {
    const auto policy = std::make_shared<const Policy>(MakePolicy(GetParam(), seed));
    ASSERT_TRUE(policy->Validate().ok()) << policy->Validate();
    const ClipTensors clip = MakeEpisode(*policy, seed);
    const TorchModel model(*policy, Surrogate{}, GetParam().arithmetic);
    const ModelOutput output = model.Forward(clip);
    const auto trained = std::make_shared<const Policy>(model.CurrentPolicy());
    ASSERT_EQ(trained->config.arithmetic, GetParam().arithmetic);
    compared += CompareWithEngine(*MakeReferenceEngine(trained), clip, output);
    compared += CompareWithEngine(*MakeEngine(trained), clip, output);
  }
  EXPECT_GE(compared, kLeastCompared * 2.0 * static_cast<double>(GetParam().policies) * kSteps);
}

INSTANTIATE_TEST_SUITE_P(Shapes, TrainerParityTest, testing::ValuesIn(Shapes()),
                         [](const auto& test) { return test.param.name; });

}  // namespace
}  // namespace spikeserve
