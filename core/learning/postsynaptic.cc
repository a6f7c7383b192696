#include "core/learning/postsynaptic.h"

#include "core/math/exp.h"

namespace spikeserve {

std::vector<float> PostsynapticActivity(Rule rule, const ActionChoice& choice) {
  const bool discrete = !choice.probabilities.empty();
  if (rule == Rule::kHebbian) {
    if (discrete) return choice.probabilities;
    std::vector<float> post = choice.logits;
    for (float& y : post) y = Tanh(y);
    return post;
  }
  if (!discrete) return choice.noise;
  std::vector<float> post = choice.probabilities;
  for (float& y : post) y = -y;
  post[static_cast<size_t>(choice.action.discrete)] += 1.0f;
  return post;
}

}  // namespace spikeserve
