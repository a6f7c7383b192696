// Defines the parameters of one SNN-DT, as row-major arrays named as in the policy file. All are
// float32, except those of integer_weights.h.
//
// Symbols: d hidden size, H heads, L layers, m routing hidden size, F FFN size, obs observation
// length, act outputs of the action head, in = d + H with phase spikes and d without. Immutable
// once they belong to a policy, and then shared by all threads.
#pragma once

#include <string>
#include <variant>
#include <vector>

#include "absl/status/status.h"
#include "core/math/tensor.h"
#include "core/model/config.h"
#include "core/model/fixed_point_weights.h"
#include "core/model/integer_weights.h"

namespace spikeserve {

// The parameters of a LayerNorm. Empty in policies without norms.
struct Norm {
  Tensor weight;  // [d]
  Tensor bias;    // [d]
};

// The parameters of a rate coder: its neurons receive the constant current x * gain + bias.
struct Coder {
  Tensor gain;  // [d]
  Tensor bias;  // [d]
};

// An affine embedding, followed by its LayerNorm.
struct Embedding {
  Linear linear;  // [d, 1 | state inputs | act], [d]
  Norm norm;
};

struct LayerWeights {
  Coder coder;              // not in dense mode
  Linear query;             // [d, in], [d]
  Linear key;               // [d, in], [d]
  Linear value;             // [d, in], [d]
  Tensor scale;             // [H]: c_h; not in dense mode, where the scale is 1/sqrt(d_h)
  Linear routing_hidden;    // [m, d], [m]; modes with routing
  Linear routing_gate;      // [H, m], [H]; modes with routing
  Linear attention_output;  // [d, d_h] ([d, d] if heads are concatenated, and in dense mode), [d]
  Norm attention_norm;
  Coder ffn_coder;    // not in dense mode
  Linear ffn_hidden;  // [F, d], [F]
  Linear ffn_output;  // [d, F], [d]
  Norm ffn_norm;
  // These two replace everything above if the arithmetic is integer.
  IntegerMaps integer;
  FixedPointLayer fixed_point;
};

struct Weights {
  Embedding embed_return;
  Embedding embed_state;
  Embedding embed_action;
  // [K, d]; dense mode only. Row min(t, K-1) is added to the tokens of timestep t before their
  // norm.
  Tensor embed_timestep;
  Tensor phase_omega;  // [H]; modes with phase
  Tensor phase_phi;    // [H]; modes with phase
  std::vector<LayerWeights> layers;
  Coder readout_coder;      // not in dense mode
  Linear head;              // [act, d], [act]
  Tensor observation_mean;  // [obs]
  Tensor observation_std;   // [obs], > 0
  // [obs], > 0: scale of the change since the timestep before; with config.observation_changes.
  Tensor observation_change_std;
  // Replaces the embeddings and the readout coder if the arithmetic is integer.
  FixedPointEnds fixed_point;
};

// Default number of rows of a dense model's timestep embedding.
inline constexpr int kDenseTimesteps = 1024;

// One tensor of a policy file: its name, the shape that the config requires (-1: any positive
// length), and its place in the weights.
struct TensorSlot {
  std::string name;
  std::vector<int> shape;
  std::variant<Tensor*, Int8Tensor*, Int16Tensor*> tensor;

  // Returns the place of a float32 tensor. REQUIRES: the tensor is float32.
  Tensor* floats() const { return std::get<Tensor*>(tensor); }
};

// Returns every tensor of a policy with this config, in a fixed order, each with a pointer to its
// place in `weights`; resizes `weights->layers`. This function alone defines the names of the
// tensors: the reader, the writer, the trainer and RandomPolicy iterate over its result.
std::vector<TensorSlot> TensorSlots(const ModelConfig& config, int observation_size,
                                    int action_size, Weights* weights);

}  // namespace spikeserve
