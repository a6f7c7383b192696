// Maps readout rates to an action.
//
// The action head is the only part of the model that plasticity may change, so it is kept outside
// the engine.
//
// All functions are thread-safe.
#pragma once

#include <cstdint>
#include <vector>

#include "absl/types/span.h"
#include "core/action/action_space.h"
#include "core/math/tensor.h"

namespace spikeserve {

// How an action is chosen from the head's logits z.
struct ActionSelection {
  bool sample = false;  // false: greedy
  // Divides the logits of a Discrete space, or is the standard deviation of the noise that is added
  // before tanh for a Box; > 0.
  float temperature = 1.0f;
};

// A chosen action, and the values that it was chosen from.
struct ActionChoice {
  Action action;
  std::vector<float> logits;  // [act]: z = W r + b
  // [act]: softmax(z), or softmax(z / temperature) when sampling; empty for a Box.
  std::vector<float> probabilities;
  // [act]: the standard normal noise of a sampled Box action, which is
  // tanh(z + temperature * noise) mapped to the bounds; empty otherwise.
  std::vector<float> noise;
};

// Chooses an action from `readout` [d]. Greedy: the first maximum of z, or tanh(z) mapped to the
// bounds. Sampled: a draw from softmax(z / temperature), or tanh of z plus Gaussian noise, mapped
// to the bounds. `random` is the key of the draws (see session.h), so a decision that is computed
// again draws the same action.
ActionChoice ChooseAction(const Linear& head, const ActionSpace& space,
                          absl::Span<const float> readout, const ActionSelection& selection,
                          uint64_t random);

// As above, but writes into `choice`, reusing its memory.
void ChooseAction(const Linear& head, const ActionSpace& space, absl::Span<const float> readout,
                  const ActionSelection& selection, uint64_t random, ActionChoice* choice);

}  // namespace spikeserve
