#include "core/learning/postsynaptic.h"

#include "core/math/exp.h"
#include "core/math/vector_view.h"

namespace spikeserve {

void PostsynapticActivity(Rule rule, const ActionChoice& choice, std::vector<float>* post) {
  const bool discrete = !choice.probabilities.empty();
  if (rule == Rule::kHebbian) {
    *post = discrete ? choice.probabilities : choice.logits;
    if (!discrete) AsVector(*post) = AsVector(*post).unaryExpr(&Tanh);
    return;
  }
  *post = discrete ? choice.probabilities : choice.noise;
  if (!discrete) return;
  AsVector(*post) = -AsVector(*post);
  (*post)[static_cast<size_t>(choice.action.discrete)] += 1.0f;
}

}  // namespace spikeserve
