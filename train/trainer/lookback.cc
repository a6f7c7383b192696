#include "train/trainer/lookback.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <tuple>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/math/exp.h"
#include "core/neuron/phase.h"

namespace spikeserve {
namespace {

constexpr double kPi = std::numbers::pi;
constexpr float kCurrent = 1.5f;   // of a neuron that fires, in thresholds
constexpr float kSilence = -0.2f;  // of a neuron that does not, against the current of the coder
// Attention score at the right timestep less the mean score at all others. The softmax gives such a
// timestep most of the weight in a window of thousands.
constexpr float kMargin = 10.0f;

constexpr float kQuarterTurn = static_cast<float>(kPi / 2.0);  // turns a sine into a cosine

// Returns the mean time of the ticks of a timestep, after its beginning.
double MeanTick(int ticks) { return (ticks - 1) / (2.0 * ticks); }

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

// Returns the frequencies of symmetric generators. The first has one half turn a timestep. Adds the
// others one at a time: the one after which a softmax gives the least weight to wrong timesteps.
std::vector<double> SymmetricFrequencies(const ModelConfig& config, int middle) {
  const int ticks = config.ticks;
  const size_t side = static_cast<size_t>(middle) + 1;
  const auto scale = 2.0f * kMargin / static_cast<float>(config.heads);  // of one generator
  // Generators that agree y steps before the middle less those that agree x steps before it, for a
  // query x steps after it: [x][y][ticks]. Where x - y is odd, generator 0 differs.
  std::vector<int> excess(side * side * ticks, 0);
  const auto add = [&](double omega) {
    std::vector<int> sum = excess;
    for (size_t x = 0; x < side; ++x) {
      for (size_t y = x % 2; y < side; y += 2) {
        for (int tick = 0; tick < ticks; ++tick) {
          const double shift = TimestepPhaseTime(0, tick, ticks) - MeanTick(ticks);
          const auto spike = [&](double steps) {
            return PhaseSpike(static_cast<float>(omega), kQuarterTurn, steps + shift);
          };
          const double after = static_cast<double>(x), before = -static_cast<double>(y);
          int& entry = sum[(x * side + y) * ticks + tick];
          entry += spike(after) == spike(before) ? 1 : 0;
          entry -= spike(after) == spike(-after) ? 1 : 0;
        }
      }
    }
    return sum;
  };
  std::vector<double> chosen = {kPi};
  while (chosen.size() < static_cast<size_t>(config.heads)) {
    double best = 0.0, least = 0.0;
    for (int m = 1; m == 1 || 2 * m <= middle + 2; ++m) {
      double wrong = 0.0;
      for (const int entry : add(m * kPi / (middle + 2)))
        wrong += Exp(scale * static_cast<float>(entry));
      if (best != 0.0 && wrong >= least) continue;
      least = wrong;
      best = m * kPi / (middle + 2);
    }
    excess = add(best);
    chosen.push_back(best);
  }
  return chosen;
}

absl::Status CheckClock(absl::string_view flag, const ModelConfig& config) {
  if (config.has_phase() && config.phase_clock == PhaseClock::kTimestep) return absl::OkStatus();
  return InvalidArgument(
      flag, "--mode=pos or full with --phase_clock=timestep",
      absl::StrCat(ToString(config.mode), " with ", ToString(config.phase_clock)));
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

// Makes every query fire with a generator, and every key with the same one, or in its antiphase.
// Sets the scale so that the right timestep has kMargin more than the mean of all others.
void Attend(bool antiphase, Policy* policy) {
  const ModelConfig& config = policy->config;
  LayerWeights& layer = policy->weights.layers[0];
  for (int row = 0; row < config.hidden_size; ++row) {
    const int k = row % config.heads;
    const bool between = row / config.heads % 2 == 1;
    FireWith(config, row, k, between, &layer.query);
    FireWith(config, row, k, between != antiphase, &layer.key);
  }
  // Half of a head's neurons fire together at the right timestep, and a quarter at all others.
  const float scale = kMargin / (static_cast<float>(config.head_size()) / 4.0f);
  std::fill(layer.scale.values.begin(), layer.scale.values.end(), scale);
}

}  // namespace

absl::Status LookBack(int delay, Policy* policy) {
  const ModelConfig& config = policy->config;
  RETURN_IF_ERROR(CheckClock("--lookback", config));
  if (delay < 1 || delay >= config.context) {
    return InvalidArgument("--lookback",
                           absl::StrCat("1 to ", config.context - 1, ", below --context"), delay);
  }
  const std::vector<double> omega = Frequencies(delay, config.heads);
  for (int k = 0; k < config.heads; ++k) {
    policy->weights.phase_omega.values[k] = static_cast<float>(omega[k]);
  }
  Attend(/*antiphase=*/true, policy);
  return absl::OkStatus();
}

absl::Status Mirror(int middle, Policy* policy) {
  const ModelConfig& config = policy->config;
  RETURN_IF_ERROR(CheckClock("--mirror", config));
  if (middle < 1 || middle > (config.context - 1) / 2) {
    return InvalidArgument(
        "--mirror",
        absl::StrCat("1 to ", (config.context - 1) / 2, ", less than half of --context"), middle);
  }
  const std::vector<double> omega = SymmetricFrequencies(config, middle);
  for (int k = 0; k < config.heads; ++k) {
    const double turns = 0.25 - omega[k] * (middle + MeanTick(config.ticks)) / (2.0 * kPi);
    policy->weights.phase_omega.values[k] = static_cast<float>(omega[k]);
    policy->weights.phase_phi.values[k] =
        static_cast<float>(2.0 * kPi * (turns - std::floor(turns)));
  }
  Attend(/*antiphase=*/false, policy);
  return absl::OkStatus();
}

}  // namespace spikeserve
