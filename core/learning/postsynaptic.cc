#include "core/learning/postsynaptic.h"

#include <algorithm>

#include "core/contract/dcheck.h"
#include "core/math/exp.h"
#include "core/math/portable.h"
#include "core/math/vector_view.h"

namespace spikeserve {

void PostsynapticActivity(Rule rule, const ActionChoice& choice, std::vector<float>* post) {
  SPIKESERVE_DCHECK_EQ(rule == Rule::kPolicyGradient && choice.probabilities.empty(),
                       rule == Rule::kPolicyGradient && !choice.noise.empty());
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

void ReplaceAction(const ActionSpace& space, absl::Span<const float> logits, float temperature,
                   const Action& answered, const Action& executed, absl::Span<float> post) {
  SPIKESERVE_DCHECK(space.Contains(answered).ok());
  SPIKESERVE_DCHECK(space.Contains(executed).ok());
  SPIKESERVE_DCHECK_EQ(post.size(), static_cast<size_t>(space.size()));
  if (space.is_discrete()) {
    post[static_cast<size_t>(answered.discrete)] -= 1.0f;
    post[static_cast<size_t>(executed.discrete)] += 1.0f;
    return;
  }
  for (size_t i = 0; i < post.size(); ++i) {
    const float value = executed.continuous[i];
    if (value == answered.continuous[i]) continue;
    const double low = space.low[i];
    const double unit = 2.0 * (value - low) / (static_cast<double>(space.high[i]) - low) - 1.0;
    const double inverse = 0.5 * portable::Log((1.0 + unit) / (1.0 - unit));  // of tanh
    const double score = (inverse - static_cast<double>(logits[i])) / temperature;
    post[i] = std::clamp(static_cast<float>(score), -kLargestExecutedScore, kLargestExecutedScore);
  }
}

}  // namespace spikeserve
