#include "core/learning/postsynaptic.h"

#include <algorithm>

#include "core/contract/dcheck.h"
#include "core/math/exp.h"
#include "core/math/portable.h"
#include "core/math/vector_view.h"

namespace spikeserve {
namespace {

// Returns element i of a continuous action, mapped from its bounds to [-1, 1].
double Unit(const ActionSpace& space, const Action& action, size_t i) {
  const double low = space.low[i];
  return 2.0 * (action.continuous[i] - low) / (static_cast<double>(space.high[i]) - low) - 1.0;
}

}  // namespace

void PostsynapticActivity(Rule rule, const ActionSpace& space, const ActionChoice& choice,
                          std::vector<float>* post) {
  SPIKESERVE_DCHECK_EQ(choice.probabilities.empty(), !space.is_discrete());
  SPIKESERVE_DCHECK_EQ(rule == Rule::kPolicyGradient && choice.probabilities.empty(),
                       rule == Rule::kPolicyGradient && !choice.noise.empty());
  const bool discrete = space.is_discrete();
  if (rule == Rule::kHebbian) {
    *post = discrete ? choice.probabilities : choice.logits;
    if (!discrete) AsVector(*post) = AsVector(*post).unaryExpr(&Tanh);
    return;
  }
  if (rule == Rule::kHebbianAction) {
    post->assign(choice.logits.size(), 0.0f);
    if (discrete) {
      (*post)[static_cast<size_t>(choice.action.discrete)] = 1.0f;
      return;
    }
    for (size_t i = 0; i < post->size(); ++i) {
      (*post)[i] = static_cast<float>(Unit(space, choice.action, i));
    }
    return;
  }
  *post = discrete ? choice.probabilities : choice.noise;
  if (!discrete) return;
  AsVector(*post) = -AsVector(*post);
  (*post)[static_cast<size_t>(choice.action.discrete)] += 1.0f;
}

void ReplaceAction(Rule rule, const ActionSpace& space, absl::Span<const float> logits,
                   float temperature, const Action& answered, const Action& executed,
                   absl::Span<float> post) {
  SPIKESERVE_DCHECK(DependsOnAction(rule));
  SPIKESERVE_DCHECK(space.Contains(answered).ok());
  SPIKESERVE_DCHECK(space.Contains(executed).ok());
  SPIKESERVE_DCHECK_EQ(post.size(), static_cast<size_t>(space.size()));
  if (space.is_discrete()) {
    post[static_cast<size_t>(answered.discrete)] -= 1.0f;
    post[static_cast<size_t>(executed.discrete)] += 1.0f;
    return;
  }
  for (size_t i = 0; i < post.size(); ++i) {
    if (executed.continuous[i] == answered.continuous[i]) continue;
    const double unit = Unit(space, executed, i);
    if (rule == Rule::kHebbianAction) {
      post[i] = static_cast<float>(unit);
      continue;
    }
    const double inverse = 0.5 * portable::Log((1.0 + unit) / (1.0 - unit));  // of tanh
    const double score = (inverse - static_cast<double>(logits[i])) / temperature;
    post[i] = std::clamp(static_cast<float>(score), -kLargestExecutedScore, kLargestExecutedScore);
  }
}

}  // namespace spikeserve
