// The postsynaptic factor y of eq. 4.1, [act], computed from how one action was chosen.
//
// z are the logits of the action head.
//
// Rule::kHebbian: y is the output of the head, which does not depend on the action that was drawn.
//   Discrete: y = softmax(z), the probabilities of the answer.
//   Box: y = tanh(z), without the noise.
//
// Rule::kHebbianAction: y is the action that was drawn.
//   Discrete: y = onehot(action), the binary spikes of the paper's section 4.
//   Box: y = tanh(u), with u = z + temperature * noise; tanh(z) for a greedy action.
//
// Rule::kPolicyGradient: y is the score d log pi(action) / dz times the temperature, so that the
// size of y does not depend on the temperature.
//   Discrete, sampled: y = onehot(action) - softmax(z / temperature).
//   Discrete, greedy: the same at temperature 1. This reinforces the first maximum of z and is not
//   an unbiased direction.
//   Box: y = (u - z) / temperature, where u = z + temperature * noise is the sample before tanh.
//   This is the standard normal noise itself, so y is exact at any temperature.
//
// Free functions, safe to call from many threads.
#pragma once

#include <vector>

#include "absl/types/span.h"
#include "core/action/action_head.h"
#include "core/action/action_space.h"
#include "core/learning/learning_options.h"

namespace spikeserve {

// Writes y into `post`, whose memory is reused. REQUIRES: `choice` belongs to `space`; for
// kPolicyGradient on a Box, a sampled choice (LearningOptions::Validate).
void PostsynapticActivity(Rule rule, const ActionSpace& space, const ActionChoice& choice,
                          std::vector<float>* post);

// Returns whether y depends on the action that was drawn, so that an executed action changes it.
inline bool DependsOnAction(Rule rule) { return rule != Rule::kHebbian; }

// Largest size of an element of y for an executed action that differs from the answered one. The
// noise of a sampled action exceeds it once in 16,000 draws. Without it, an action at a bound,
// where tanh^-1 is infinite, would make y infinite.
inline constexpr float kLargestExecutedScore = 4.0f;

// Changes `post`, which holds y for `answered`, to y for `executed`. In a Box `unit` is the
// executed value mapped from its bounds to [-1, 1]; the elements that were executed as answered
// keep their y.
//   kPolicyGradient, discrete: y = onehot(executed) - softmax(z / temperature).
//   kPolicyGradient, Box: y = (tanh^-1(unit) - z) / temperature, limited to kLargestExecutedScore.
//   kHebbianAction: y = onehot(executed), or `unit`.
// REQUIRES: DependsOnAction(rule); both actions belong to `space`; `logits` are the z of the
// answer.
void ReplaceAction(Rule rule, const ActionSpace& space, absl::Span<const float> logits,
                   float temperature, const Action& answered, const Action& executed,
                   absl::Span<float> post);

}  // namespace spikeserve
