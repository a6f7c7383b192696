// The action head: from readout rates to an action. The only part of the model that plasticity may
// change, which is why it stands outside the engine.
//
// Free functions, safe to call from many threads.
#ifndef CORE_ACTION_ACTION_HEAD_H_
#define CORE_ACTION_ACTION_HEAD_H_

#include <cstdint>
#include <vector>

#include "absl/types/span.h"
#include "core/action/action_space.h"
#include "core/math/tensor.h"

namespace spikeserve {

struct ActionSelection {
  bool sample = false;  // greedy otherwise
  float temperature =
      1.0f;  // > 0; divides the logits, or is the deviation of the noise before tanh
};

struct ActionChoice {
  Action action;
  std::vector<float> logits;  // [act]: z = W r + b
  std::vector<float>
      probabilities;         // [act]: softmax(z), at temperature when sampling; empty for a Box
  std::vector<float> noise;  // [act]: a sampled Box action is tanh(z + temperature * noise), noise
                             // standard normal; empty otherwise
};

// Greedy: the first maximum of z, or tanh(z) mapped to the bounds. Sampled: a draw from softmax(z /
// temperature), or Gaussian noise on z before tanh; `random` is a stateless draw key (see
// session.h), so that a decision computed again draws the same action. `readout` is [d].
ActionChoice ChooseAction(const Linear& head, const ActionSpace& space,
                          absl::Span<const float> readout, const ActionSelection& selection,
                          uint64_t random);

// The same, into a choice whose memory is used again.
void ChooseAction(const Linear& head, const ActionSpace& space, absl::Span<const float> readout,
                  const ActionSelection& selection, uint64_t random, ActionChoice* choice);

}  // namespace spikeserve

#endif  // CORE_ACTION_ACTION_HEAD_H_
