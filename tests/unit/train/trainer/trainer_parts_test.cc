#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <numeric>
#include <string>
#include <utility>
#include <vector>

#include "core/learning/learner.h"
#include "core/math/counter_random.h"
#include "core/neuron/phase.h"
#include "tests/support/small_policy.h"
#include "train/trainer/activity_router.h"
#include "train/trainer/head_plasticity.h"
#include "train/trainer/lookback.h"

namespace spikeserve {
namespace {

using testing::HasSubstr;

// Returns the share of the generators whose spikes at `timestep` and `distance` steps before are
// those of a neuron that fires with a generator and one that fires between its spikes.
double Match(const Policy& policy, int timestep, int distance) {
  const Weights& weights = policy.weights;
  int matches = 0;
  for (int k = 0; k < policy.config.heads; ++k) {
    const float omega = weights.phase_omega.values[k], phi = weights.phase_phi.values[k];
    matches += PhaseSpike(omega, phi, timestep) != PhaseSpike(omega, phi, timestep - distance);
  }
  return static_cast<double>(matches) / policy.config.heads;
}

TEST(LookBackTest, QueriesMatchTheKeysOfOneTimestepAlone) {
  ModelConfig config = SmallConfig(Mode::kPos);
  config.hidden_size = 64;
  config.heads = 8;
  config.context = 64;
  for (const int delay : {31, 63}) {
    Policy policy = SmallPolicy(config);
    ASSERT_TRUE(LookBack(delay, &policy).ok());
    EXPECT_TRUE(policy.Validate().ok());
    std::vector<double> mean(config.context);
    for (int t = config.context; t < 264; ++t) {
      for (int distance = 0; distance < config.context; ++distance) {
        mean[distance] += Match(policy, t, distance) / 200;
      }
    }
    for (int distance = 0; distance < config.context; ++distance) {
      if (distance == delay) {
        EXPECT_GT(mean[distance], 0.99);
      } else if (distance < delay) {
        EXPECT_LT(mean[distance], 0.75) << delay << " " << distance;
      }
    }
    const LayerWeights& layer = policy.weights.layers[0];
    const int inputs = config.attention_inputs();
    for (int row = 0; row < config.hidden_size; ++row) {
      for (int k = config.hidden_size; k < inputs; ++k) {
        const size_t i = static_cast<size_t>(row) * inputs + k;
        const float weight = layer.query.weight.values[i];
        EXPECT_EQ(weight, -layer.key.weight.values[i]);
        EXPECT_EQ(weight != 0.0f, k - config.hidden_size == row % config.heads);
      }
    }
  }
}

// Returns how many neurons of a head fire together at two timesteps, if each generator has two in
// it.
int Overlap(const Policy& policy, int query, int key, int tick) {
  const Weights& weights = policy.weights;
  int overlap = 0;
  for (int k = 0; k < policy.config.heads; ++k) {
    const auto spike = [&](int timestep) {
      return PhaseSpike(weights.phase_omega.values[k], weights.phase_phi.values[k],
                        TimestepPhaseTime(timestep, tick, policy.config.ticks));
    };
    overlap += spike(query) == spike(key) ? 1 : 0;
  }
  return overlap;
}

TEST(MirrorTest, QueriesMatchTheKeysOfTheMirroredTimestepAlone) {
  ModelConfig config = SmallConfig(Mode::kPos);
  config.hidden_size = 128;
  config.heads = 8;
  config.ticks = 8;
  config.context = 103;
  const int middle = 51;
  Policy policy = SmallPolicy(config);
  ASSERT_TRUE(Mirror(middle, &policy).ok());
  EXPECT_TRUE(policy.Validate().ok());
  const LayerWeights& layer = policy.weights.layers[0];
  double mean_share = 0.0;
  for (int x = 1; x <= middle; ++x) {
    std::vector<double> shares(middle + 1);  // of the attention from middle + x, at middle - y
    for (int tick = 0; tick < config.ticks; ++tick) {
      std::vector<double> weights;
      for (int y = 0; y <= middle; ++y) {
        const int overlap = Overlap(policy, middle + x, middle - y, tick);
        weights.push_back(std::exp(layer.scale.values[0] * overlap));
      }
      const double sum = std::accumulate(weights.begin(), weights.end(), 0.0);
      for (int y = 0; y <= middle; ++y) shares[y] += weights[y] / sum / config.ticks;
    }
    mean_share += shares[x] / middle;
    const double right = std::exchange(shares[x], 0.0);
    EXPECT_GT(0.95 * right, *std::max_element(shares.begin(), shares.end())) << x;
  }
  EXPECT_GT(mean_share, 0.5);
  const int inputs = config.attention_inputs();
  for (int row = 0; row < config.hidden_size; ++row) {
    for (int k = config.hidden_size; k < inputs; ++k) {
      const size_t i = static_cast<size_t>(row) * inputs + k;
      EXPECT_EQ(layer.query.weight.values[i], layer.key.weight.values[i]);
      EXPECT_EQ(layer.query.weight.values[i] != 0.0f, k - config.hidden_size == row % config.heads);
    }
  }
}

TEST(MirrorTest, RefusesAMiddleWhoseStartIsOutsideOfTheContext) {
  ModelConfig config = SmallConfig(Mode::kPos);
  config.context = 9;
  Policy policy = SmallPolicy(config);
  EXPECT_TRUE(Mirror(4, &policy).ok());
  EXPECT_FALSE(Mirror(5, &policy).ok());
  EXPECT_FALSE(Mirror(0, &policy).ok());
  policy = SmallPolicy(SmallConfig(Mode::kBaseline));
  EXPECT_FALSE(Mirror(1, &policy).ok());
}

constexpr int kClipSteps = 7;
constexpr double kMean = 3.0, kDeviation = 2.0;

torch::Tensor Random(std::vector<int64_t> shape, double least, double most) {
  static uint64_t draw = 0;
  torch::Tensor values = torch::empty(shape);
  auto* data = values.data_ptr<float>();
  for (int64_t i = 0; i < values.numel(); ++i) {
    data[i] = static_cast<float>(least + (most - least) * UniformDouble(RandomBits({draw++})));
  }
  return values;
}

std::vector<float> Values(const torch::Tensor& tensor) {
  const torch::Tensor whole = tensor.contiguous();
  return {whole.data_ptr<float>(), whole.data_ptr<float>() + whole.numel()};
}

// Two clips, the second one of which ends after three steps.
struct TwoClips {
  ModelOutput output;
  PlasticityInputs inputs;
};

TwoClips MakeClips(const Policy& policy) {
  const ActionSpace& space = policy.action_space;
  TwoClips clips;
  clips.output.logits = Random({2, kClipSteps, space.size()}, -2.0, 2.0);
  clips.output.readout = Random({2, kClipSteps, policy.config.hidden_size}, 0.0, 1.0);
  clips.inputs.return_to_go = Random({2, kClipSteps}, -2.0, 8.0);
  clips.inputs.mask = torch::ones({2, kClipSteps});
  clips.inputs.mask[1].slice(0, 3) = 0.0;
  clips.inputs.targets = space.is_discrete()
                             ? torch::one_hot(torch::arange(2 * kClipSteps) % space.size())
                                   .to(torch::kFloat)
                                   .view({2, kClipSteps, space.size()})
                             : Random({2, kClipSteps, space.size()}, -0.9, 0.9);
  clips.inputs.mean = kMean;
  clips.inputs.deviation = kDeviation;
  return clips;
}

// Returns what a session learns that makes the decisions of one clip, by the learner of the server.
std::vector<float> Learned(const HeadPlasticity& plasticity, Policy policy, const TwoClips& clips,
                           int clip, int steps) {
  policy.modulator_mean = kMean;
  policy.modulator_std = kDeviation;
  LearningOptions options;
  options.rule = plasticity.rule;
  options.modulator = Modulator::kTarget;
  options.learning_rate = plasticity.rate;
  options.trace_decay = plasticity.trace_decay;
  options.clip = options.max_drift = 1e9;
  Learner learner =
      Learner::New(options, policy,
                   Eigen::VectorXf::Zero(policy.action_space.size() * policy.config.hidden_size));
  for (int t = 0; t < steps; ++t) {
    ActionChoice choice;
    const torch::Tensor logits = clips.output.logits[clip][t];
    choice.logits = Values(logits);
    if (policy.action_space.is_discrete()) {
      choice.probabilities = Values(torch::softmax(logits, -1));
      choice.action.discrete = clips.inputs.targets[clip][t].argmax().item<int64_t>();
    } else if (plasticity.rule == Rule::kHebbianAction) {
      choice.action.continuous = Values(clips.inputs.targets[clip][t]);
    } else if (plasticity.rule == Rule::kPolicyGradient) {
      choice.noise = Values(torch::atanh(clips.inputs.targets[clip][t]) - logits);
    }
    learner.OnDecision(options, policy, choice, Values(clips.output.readout[clip][t]),
                       clips.inputs.return_to_go[clip][t].item<double>(), 0.0);
  }
  return {learner.head_delta.begin(), learner.head_delta.end()};
}

class HeadPlasticityTest : public testing::TestWithParam<Rule> {};

TEST_P(HeadPlasticityTest, ChangesTheHeadAsSessionsLearn) {
  const HeadPlasticity plasticity = {.rate = 0.02, .rule = GetParam(), .trace_decay = 0.8};
  for (const ActionSpace& space :
       {ActionSpace::Discrete(3), ActionSpace::Box({-1.0f, -1.0f}, {1.0f, 1.0f})}) {
    const Policy policy = SmallPolicy(SmallConfig(), space);
    const TwoClips clips = MakeClips(policy);
    const std::vector<float> first = Learned(plasticity, policy, clips, 0, kClipSteps);
    const std::vector<float> second = Learned(plasticity, policy, clips, 1, 3);
    const std::vector<float> change =
        Values(HeadChange(plasticity, space, clips.output, clips.inputs));
    ASSERT_EQ(change.size(), first.size());
    for (size_t i = 0; i < change.size(); ++i) {
      EXPECT_NEAR(change[i], (first[i] + second[i]) / 2.0f, 1e-5f);
    }
    EXPECT_NE(first, second);
  }
}

INSTANTIATE_TEST_SUITE_P(Rules, HeadPlasticityTest,
                         testing::Values(Rule::kHebbian, Rule::kHebbianAction,
                                         Rule::kPolicyGradient),
                         [](const auto& of) { return std::string(ToString(of.param)); });

TEST(ActivityRouterTest, TheHiddenLayerHasTheMeanOfEachHead) {
  ModelConfig config = SmallConfig(Mode::kRoute);
  config.routing_hidden_size = config.heads;
  Policy policy = SmallPolicy(config);
  ASSERT_TRUE(RouteByActivity(&policy).ok());
  EXPECT_TRUE(policy.Validate().ok());
  const torch::Tensor heads = Random({config.heads, config.head_size()}, 0.0, 1.0);
  for (const LayerWeights& layer : policy.weights.layers) {
    const Linear& hidden = layer.routing_hidden;
    const torch::Tensor weight =
        torch::tensor(hidden.weight.values).view({config.heads, config.hidden_size});
    const torch::Tensor seen =
        torch::relu(torch::matmul(weight, heads.flatten()) + torch::tensor(hidden.bias.values));
    EXPECT_TRUE(torch::allclose(seen, heads.mean(1)));
  }
}

TEST(ActivityRouterTest, RefusesOtherSizesAndModes) {
  ModelConfig config = SmallConfig(Mode::kRoute);
  config.routing_hidden_size = config.heads + 1;
  Policy policy = SmallPolicy(config);
  EXPECT_THAT(std::string(RouteByActivity(&policy).message()),
              testing::StartsWith("--activity_router: expected --routing_hidden_size="));
  Policy without = SmallPolicy(SmallConfig(Mode::kPos));
  EXPECT_EQ(RouteByActivity(&without).message(),
            "--activity_router: expected --mode=route or full, received pos");
}

}  // namespace
}  // namespace spikeserve
