// The postsynaptic factor y of eq. 4.1, [act], from how one action was chosen.
//
// hebbian, the paper's letter: the head's own output, whatever action was drawn from it.
//   Discrete: softmax(z), the probabilities the answer reports.
//   Box: tanh(z), before noise.
// policy_gradient: the score d log pi(action) / dz times the temperature, so that its size does
// not depend on how much is explored.
//   Discrete: onehot(action) - softmax(z / temperature) when sampled; when greedy the temperature
//   is 1, and y reinforces the first maximum without being an unbiased direction.
//   Box: (u - z) / temperature with u = z + temperature * noise the sample before tanh, so the
//   standard normal noise itself, exact however small the temperature is.
//
// A free function, safe to call from many threads.
#ifndef CORE_LEARNING_POSTSYNAPTIC_H_
#define CORE_LEARNING_POSTSYNAPTIC_H_

#include <vector>

#include "core/action/action_head.h"
#include "core/learning/learning_options.h"

namespace spikeserve {

// REQUIRES: for kPolicyGradient on a Box, a sampled choice (LearningOptions::Validate).
std::vector<float> PostsynapticActivity(Rule rule, const ActionChoice& choice);

}  // namespace spikeserve

#endif  // CORE_LEARNING_POSTSYNAPTIC_H_
