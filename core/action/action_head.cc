#include "core/action/action_head.h"

#include <algorithm>
#include <cmath>

#include "core/contract/dcheck.h"
#include "core/math/counter_random.h"
#include "core/math/exp.h"
#include "core/math/portable.h"

namespace spikeserve {
namespace {

void Logits(const Linear& head, absl::Span<const float> readout, std::vector<float>* logits) {
  SPIKESERVE_DCHECK_EQ(head.weight.values.size(), head.bias.values.size() * readout.size());
  *logits = head.bias.values;
  for (size_t i = 0; i < logits->size(); ++i) {
    const float* row = head.weight.values.data() + i * readout.size();
    float logit = (*logits)[i];  // in a register, where the additions do not wait for memory
    for (size_t j = 0; j < readout.size(); ++j) logit += row[j] * readout[j];
    (*logits)[i] = logit;
  }
}

void Softmax(const std::vector<float>& logits, float temperature,
             std::vector<float>* probabilities) {
  SPIKESERVE_DCHECK_GT(temperature, 0.0f);
  const float best = *std::max_element(logits.begin(), logits.end());
  probabilities->resize(logits.size());
  float sum = 0.0f;
  for (size_t i = 0; i < logits.size(); ++i) {
    (*probabilities)[i] = Exp((logits[i] - best) / temperature);
    sum += (*probabilities)[i];
  }
  for (float& p : *probabilities) p /= sum;
}

int SampleIndex(const std::vector<float>& probabilities, uint64_t random) {
  const double draw = UniformDouble(MixBits(random));
  double cumulative = 0.0;
  for (size_t i = 0; i + 1 < probabilities.size(); ++i) {
    cumulative += static_cast<double>(probabilities[i]);
    if (draw < cumulative) return static_cast<int>(i);
  }
  return static_cast<int>(probabilities.size()) - 1;
}

// Returns a standard normal draw (Box & Muller, 1958).
float Normal(uint64_t random, size_t index) {
  const double u = 1.0 - UniformDouble(RandomBits({random, index, 0}));  // in (0, 1]
  const double v = UniformDouble(RandomBits({random, index, 1}));
  return static_cast<float>(std::sqrt(-2.0 * portable::Log(u)) * portable::CosOfTurns(v));
}

}  // namespace

ActionChoice ChooseAction(const Linear& head, const ActionSpace& space,
                          absl::Span<const float> readout, const ActionSelection& selection,
                          uint64_t random) {
  ActionChoice choice;
  ChooseAction(head, space, readout, selection, random, &choice);
  return choice;
}

void ChooseAction(const Linear& head, const ActionSpace& space, absl::Span<const float> readout,
                  const ActionSelection& selection, uint64_t random, ActionChoice* choice) {
  Logits(head, readout, &choice->logits);
  const std::vector<float>& z = choice->logits;
  choice->probabilities.clear();
  choice->noise.clear();
  choice->action.discrete = 0;
  choice->action.continuous.clear();
  if (space.is_discrete()) {
    Softmax(z, selection.sample ? selection.temperature : 1.0f, &choice->probabilities);
    choice->action.discrete =
        selection.sample ? SampleIndex(choice->probabilities, random)
                         : static_cast<int>(std::max_element(z.begin(), z.end()) - z.begin());
    return;
  }
  for (size_t i = 0; i < z.size(); ++i) {
    float unit = z[i];
    if (selection.sample) {
      choice->noise.push_back(Normal(random, i));
      unit += selection.temperature * choice->noise[i];
    }
    choice->action.continuous.push_back(space.FromUnit(Tanh(unit), i));
  }
}

}  // namespace spikeserve
