// The postsynaptic factor y of eq. 4.1, [act], computed from how one action was chosen.
//
// z are the logits of the action head.
//
// Rule::kHebbian: y is the output of the head, which does not depend on the action that was drawn.
//   Discrete: y = softmax(z), the probabilities of the answer.
//   Box: y = tanh(z), without the noise.
//
// Rule::kPolicyGradient: y is the score d log pi(action) / dz times the temperature, so that the
// size of y does not depend on the temperature.
//   Discrete, sampled: y = onehot(action) - softmax(z / temperature).
//   Discrete, greedy: the same at temperature 1. This reinforces the first maximum of z and is not
//   an unbiased direction.
//   Box: y = (u - z) / temperature, where u = z + temperature * noise is the sample before tanh.
//   This is the standard normal noise itself, so y is exact at any temperature.
//
// A free function, safe to call from many threads.
#ifndef CORE_LEARNING_POSTSYNAPTIC_H_
#define CORE_LEARNING_POSTSYNAPTIC_H_

#include <vector>

#include "core/action/action_head.h"
#include "core/learning/learning_options.h"

namespace spikeserve {

// Writes y into `post`, whose memory is reused. REQUIRES: for kPolicyGradient on a Box, a sampled
// choice (LearningOptions::Validate).
void PostsynapticActivity(Rule rule, const ActionChoice& choice, std::vector<float>* post);

}  // namespace spikeserve

#endif  // CORE_LEARNING_POSTSYNAPTIC_H_
