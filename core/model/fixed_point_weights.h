// Defines the parameters of a policy in integer arithmetic (Arithmetic::kInteger), beside the
// populations of integer_weights.h. docs/design/integer.md defines how decisions use them.
//
// A number with f fraction bits stands for itself / 2^f. Symbols as in weights.h, T ticks. Plain
// values.
#pragma once

#include <cstdint>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "core/math/tensor.h"
#include "core/model/config.h"

namespace spikeserve {

// Fraction bits of the outputs of attention, of the gates, and of the routing's hidden values and
// scores.
inline constexpr int kGateFraction = 8;
// The largest output of attention, which has 8 bits.
inline constexpr int kLargestAttended = 255;
// The largest magnitude of a number of the residual stream and of an embedding's input. -32768 is
// not used, so that a coder may change the sign.
inline constexpr int kLargestResidual = 32767;
// Fraction bits of the scale of a head, which counts octaves of a key's weight for each spike by
// which the key's overlap falls short of the best one.
inline constexpr int kScaleFraction = 8;

// The affine map y_k = RoundShift(sum over j of weight_kj * x_j, shift_k) + bias_k.
struct FixedPointMap {
  Int8Tensor weight;  // [out, in]
  Int8Tensor shift;   // [out], -15 to 31; negative: to the left
  Int16Tensor bias;   // [out]
};

// An integer norm. The weight includes sqrt(d). Empty in policies without norms.
struct FixedPointNorm {
  Int16Tensor weight;  // [d]
  Int8Tensor shift;    // [1], 0 to 15
  Int16Tensor bias;    // [d]
};

// A rate coder as a table: neuron j fires with the smallest period n for which
// sign_j * x_j > threshold_jn, and not at all if there is none.
struct PeriodCoder {
  Int8Tensor sign;        // [d], 1 or -1
  Int16Tensor threshold;  // [d, T], never increasing with n
};

struct FixedPointEmbedding {
  FixedPointMap linear;  // [d, 1 | obs | act], [d]
  FixedPointNorm norm;
};

// The parts of a layer beside its populations. A dense policy has no coders, but the four maps.
struct FixedPointLayer {
  FixedPointMap query;       // [d, d], [d]
  FixedPointMap key;         // [d, d], [d]
  FixedPointMap value;       // [d, d], [d]
  FixedPointMap ffn_hidden;  // [F, d], [F]
  PeriodCoder coder;
  Int16Tensor attention_scale;  // [H]
  FixedPointMap routing_hidden;
  FixedPointMap routing_gate;
  FixedPointMap attention_output;
  FixedPointNorm attention_norm;
  PeriodCoder ffn_coder;
  FixedPointMap ffn_output;
  FixedPointNorm ffn_norm;
};

// The parts of a policy before the first layer and behind the last one.
struct FixedPointEnds {
  FixedPointEmbedding embed_return;
  FixedPointEmbedding embed_state;
  FixedPointEmbedding embed_action;
  PeriodCoder readout_coder;   // not in dense mode
  Int16Tensor embed_timestep;  // [K, d]; dense mode only
};

// Return INVALID_ARGUMENT if a number is out of its range, or if one of 32 bits could overflow for
// some input. The message names the tensor, the neuron and the bound. REQUIRES: the tensors have
// the shapes of TensorSlots.
absl::Status CheckFixedPointLayer(absl::string_view name, const ModelConfig& config,
                                  const FixedPointLayer& layer);
absl::Status CheckFixedPointEnds(const ModelConfig& config, const FixedPointEnds& ends);

}  // namespace spikeserve
