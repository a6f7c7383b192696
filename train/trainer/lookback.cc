#include "train/trainer/lookback.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <tuple>
#include <vector>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

constexpr double kPi = std::numbers::pi;
constexpr float kCurrent = 1.5f;   // of a neuron that fires, in thresholds
constexpr float kSilence = -0.2f;  // of a neuron that does not, against the current of the coder
// Attention score at the right timestep less the mean score at all others. The softmax gives such a
// timestep most of the weight in a window of thousands.
constexpr float kMargin = 10.0f;

// Returns the share of time for which two square waves with this phase shift are equal.
double Agreement(double shift) {
  const double turns = shift / (2.0 * kPi);
  return std::abs(1.0 - 2.0 * (turns - std::floor(turns)));
}

// Returns the frequencies of `count` generators. Adds one at a time: the one after which the
// largest agreement at a wrong timestep is least.
std::vector<double> Frequencies(int delay, int count) {
  std::vector<double> chosen;
  std::vector<double> agreement(delay, 0.0);  // at distances 1 to `delay` from the right timestep
  const auto add = [&](double omega) {
    std::vector<double> sum = agreement;
    for (int i = 0; i < delay; ++i) sum[i] += Agreement(omega * (i + 1));
    return sum;
  };
  for (int k = 0; k < count; ++k) {
    std::tuple<double, double> least;
    double best = 0.0;
    for (int odd = 1; odd <= delay; odd += 2) {
      const double omega = odd * kPi / delay;
      const std::vector<double> sum = add(omega);
      double squares = 0.0;
      for (const double x : sum) squares += x * x;
      const std::tuple cost(*std::max_element(sum.begin(), sum.end()), squares);
      if (best != 0.0 && cost >= least) continue;
      least = cost;
      best = omega;
    }
    agreement = add(best);
    chosen.push_back(best);
  }
  return chosen;
}

// Makes neuron `row` fire at the phase spikes of generator `k`, or between them.
void FireWith(const ModelConfig& config, int row, int k, bool between, Linear* linear) {
  const int inputs = config.attention_inputs();
  float* const weights = linear->weight.values.data() + static_cast<size_t>(row) * inputs;
  std::fill(weights + config.hidden_size, weights + inputs, 0.0f);
  const float current = kCurrent * config.threshold, silence = kSilence * config.threshold;
  weights[config.hidden_size + k] = between ? -current : current;
  linear->bias.values[row] = between ? current + silence : silence;
}

}  // namespace

absl::Status LookBack(int delay, Policy* policy) {
  const ModelConfig& config = policy->config;
  if (!config.has_phase() || config.phase_clock != PhaseClock::kTimestep) {
    return absl::InvalidArgumentError(absl::StrCat(
        "--lookback: expected --mode=pos or full with --phase_clock=timestep, received ",
        ToString(config.mode), " with ", ToString(config.phase_clock)));
  }
  if (delay < 1 || delay >= config.context) {
    return absl::InvalidArgumentError(absl::StrCat("--lookback: expected 1 to ", config.context - 1,
                                                   ", below --context, received ", delay));
  }
  const std::vector<double> omega = Frequencies(delay, config.heads);
  for (int k = 0; k < config.heads; ++k) {
    policy->weights.phase_omega.values[k] = static_cast<float>(omega[k]);
  }
  LayerWeights& layer = policy->weights.layers[0];
  for (int row = 0; row < config.hidden_size; ++row) {
    const int k = row % config.heads;
    const bool between = row / config.heads % 2 == 1;
    FireWith(config, row, k, between, &layer.query);
    FireWith(config, row, k, !between, &layer.key);
  }
  // Half of a head's neurons fire together at the right timestep, and a quarter at all others.
  const float scale = kMargin / (static_cast<float>(config.head_size()) / 4.0f);
  std::fill(layer.scale.values.begin(), layer.scale.values.end(), scale);
  return absl::OkStatus();
}

}  // namespace spikeserve
