// Three-factor plasticity of the action head in offline training (algorithm 1 and section 4.1.4).
//
// Pure functions. Symbols: B clips, n timesteps per clip, d hidden size, act outputs of the head.
#pragma once

#include <torch/types.h>

#include "core/action/action_space.h"
#include "core/learning/learning_options.h"
#include "train/model/clip_tensors.h"

namespace spikeserve {

// How the head learns locally, beside AdamW or, with a frozen head, instead of it.
struct HeadPlasticity {
  double rate = 0.0;  // eta of eq. 4.3; 0: the head does not learn locally
  Rule rule = Rule::kPolicyGradient;
  double trace_decay = LearningOptions().trace_decay;  // lambda of eq. 4.1, in [0, 1]
};

// What the rule reads of a batch.
struct PlasticityInputs {
  torch::Tensor return_to_go;  // [B, n]
  torch::Tensor targets;       // [B, n, act], encoded actions
  torch::Tensor mask;          // [B, n]: 0 after the end of an episode
  double mean = 0.0;           // mu of eq. 4.2
  double deviation = 1.0;      // sigma, > 0
};

// Returns the change of the head's weights [act, d], the mean over the clips of
//
//   eta sum_t clip((G_t - mu) / sigma, -1, 1) E_t,   E_t = lambda E_{t-1} + y_t r_t^T,   E_0 = 0
//
// r_t are the readout rates. y_t is that of the rule (core/learning/postsynaptic.h) with the
// recorded action as the executed one at temperature 1. A Box's y_t is limited to
// kLargestExecutedScore.
torch::Tensor HeadChange(const HeadPlasticity& plasticity, const ActionSpace& space,
                         const ModelOutput& output, const PlasticityInputs& inputs);

}  // namespace spikeserve
