#include "train/trainer/lookback.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <numeric>
#include <string>
#include <utility>
#include <vector>

#include "core/neuron/phase.h"
#include "tests/support/small_policy.h"

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

}  // namespace
}  // namespace spikeserve
