// The parameters of one SNN-DT, as plain row-major float32 arrays named as in the policy file.
//
// Symbols: d hidden size, H heads, L layers, m routing hidden size, F FFN size, obs observation
// length, act action head outputs, in = d + H with phase spikes and d without. Immutable once a
// policy holds them, and then shared by every thread.
#ifndef CORE_MODEL_WEIGHTS_H_
#define CORE_MODEL_WEIGHTS_H_

#include <functional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "core/math/tensor.h"
#include "core/model/config.h"

namespace spikeserve {

struct Norm {
  Tensor weight;  // [d]
  Tensor bias;    // [d]
};

// x * gain + bias is the constant current into the coder's neurons.
struct Coder {
  Tensor gain;  // [d]
  Tensor bias;  // [d]
};

struct Embedding {
  Linear linear;  // [d, 1 | obs | act], [d]
  Norm norm;
};

struct LayerWeights {
  Coder coder;              // not in dense mode
  Linear query;             // [d, in], [d]
  Linear key;               // [d, in], [d]
  Linear value;             // [d, in], [d]
  Tensor scale;             // c_h [H]; not in dense mode, where the scale is 1/sqrt(d_h)
  Linear routing_hidden;    // [m, d], [m]; modes with routing
  Linear routing_gate;      // [H, m], [H]; modes with routing
  Linear attention_output;  // [d, d_h] ([d, d] for concat and dense), [d]
  Norm attention_norm;
  Coder ffn_coder;    // not in dense mode
  Linear ffn_hidden;  // [F, d], [F]
  Linear ffn_output;  // [d, F], [d]
  Norm ffn_norm;
};

struct Weights {
  Embedding embed_return;
  Embedding embed_state;
  Embedding embed_action;
  Tensor embed_timestep;  // [K, d]; dense mode only. Timestep t uses row min(t, K-1), added before
                          // the norm.
  Tensor phase_omega;     // [H]; modes with phase
  Tensor phase_phi;       // [H]; modes with phase
  std::vector<LayerWeights> layers;
  Coder readout_coder;      // not in dense mode
  Linear head;              // [act, d], [act]
  Tensor observation_mean;  // [obs]
  Tensor observation_std;   // [obs], > 0
};

// Rows of the timestep embedding a dense model is given where nothing says otherwise.
inline constexpr int kDenseTimesteps = 1024;

// One named tensor of a policy file and the shape its config calls for (-1: any positive length).
struct TensorSlot {
  std::string name;
  std::vector<int> shape;
  Tensor* tensor;
};

// Every tensor a policy of this shape has, in a fixed order, each bound to its place in `weights`;
// resizes `weights->layers`. This list is the one place that knows the names: the reader, the
// writer, the trainer and random initialisation all walk it.
std::vector<TensorSlot> TensorSlots(const ModelConfig& config, int observation_size,
                                    int action_size, Weights* weights);

}  // namespace spikeserve

#endif  // CORE_MODEL_WEIGHTS_H_
