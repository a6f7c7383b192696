#include "core/engine/reference/populations.h"

#include "core/neuron/lif.h"

namespace spikeserve {
namespace {

int CountOf(const SpikeTrain& train, size_t neuron) {
  int count = 0;
  for (const auto& tick : train) count += tick[neuron];
  return count;
}

// Returns the current into output neuron i at `tick` (1 ... T).
float Current(const Linear& linear, int i, const CodedToken& coded, const SpikeTrain& phase,
              int tick) {
  float current = linear.bias.values[i];
  for (int n = 1; n <= tick; ++n) {
    if (tick % n != 0) continue;
    float group = 0.0f;
    for (const int j : coded.groups[n - 1]) group += linear.weight.at(i, j);
    current += group;
  }
  const auto first_phase = static_cast<int>(coded.spikes[tick - 1].size());
  for (size_t k = 0; k < phase[tick - 1].size(); ++k) {
    if (phase[tick - 1][k]) current += linear.weight.at(i, first_phase + static_cast<int>(k));
  }
  return current;
}

}  // namespace

std::vector<float> Affine(const Linear& linear, const std::vector<float>& input) {
  std::vector<float> output = linear.bias.values;
  for (size_t i = 0; i < output.size(); ++i) {
    for (size_t j = 0; j < input.size(); ++j) {
      output[i] += linear.weight.at(static_cast<int>(i), static_cast<int>(j)) * input[j];
    }
  }
  return output;
}

float Rate(const SpikeTrain& train, int neuron) {
  return static_cast<float>(CountOf(train, neuron)) / static_cast<float>(train.size());
}

SpikeTrain Fire(const ModelConfig& config, const Linear& linear, const CodedToken& coded,
                const SpikeTrain& phase) {
  const Lif lif = {config.membrane_decay, config.threshold};
  const int outputs = linear.weight.shape[0];
  SpikeTrain train(config.ticks, std::vector<uint8_t>(outputs, 0));
  for (int i = 0; i < outputs; ++i) {
    float membrane = 0.0f;
    for (int tick = 1; tick <= config.ticks; ++tick) {
      train[tick - 1][i] = lif.Step(Current(linear, i, coded, phase, tick), membrane);
    }
  }
  return train;
}

}  // namespace spikeserve
