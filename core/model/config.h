// Defines the sizes and variants of one SNN-DT, as stored in a policy file.
//
// Plain values; safe to copy and to share between threads.
#pragma once

#include <array>

#include "absl/status/status.h"
#include "core/base/enum_names.h"

namespace spikeserve {

// The variants of the paper's ablation (section 5.3), and an ordinary decision transformer (kDense)
// for comparison.
enum class Mode { kBaseline, kPos, kRoute, kFull, kDense };

// The clock of the phase generators (eq. 4.4). kTimestep encodes the position in the episode.
// kWindow is the paper's literal formula, which gives every token the same code.
enum class PhaseClock { kTimestep, kWindow };

// How the gated heads are merged into one vector: summed (eq. 4.11), or concatenated.
enum class Merge { kSum, kConcat };

// How routing scores are converted to gates: by a softmax over the heads (eq. 4.10), or by the
// appendix's sigmoid.
enum class Gate { kSoftmax, kSigmoid };

// What follows each addition to the residual stream: a LayerNorm, or nothing.
enum class NormKind { kLayer, kNone };

// The numbers of a policy. kInteger: everything from the rounded observation to the inputs of the
// action head is an integer (docs/design/integer.md, fixed_point_weights.h).
enum class Arithmetic { kFloat32, kInteger };

// Names in policy files and on command lines; see enum_names.h.
constexpr std::array<EnumName<Mode>, 5> EnumNames(Mode) {
  return {{{Mode::kBaseline, "baseline"},
           {Mode::kPos, "pos"},
           {Mode::kRoute, "route"},
           {Mode::kFull, "full"},
           {Mode::kDense, "dense"}}};
}
constexpr std::array<EnumName<PhaseClock>, 2> EnumNames(PhaseClock) {
  return {{{PhaseClock::kTimestep, "timestep"}, {PhaseClock::kWindow, "window"}}};
}
constexpr std::array<EnumName<Merge>, 2> EnumNames(Merge) {
  return {{{Merge::kSum, "sum"}, {Merge::kConcat, "concat"}}};
}
constexpr std::array<EnumName<Gate>, 2> EnumNames(Gate) {
  return {{{Gate::kSoftmax, "softmax"}, {Gate::kSigmoid, "sigmoid"}}};
}
constexpr std::array<EnumName<NormKind>, 2> EnumNames(NormKind) {
  return {{{NormKind::kLayer, "layer"}, {NormKind::kNone, "none"}}};
}
constexpr std::array<EnumName<Arithmetic>, 2> EnumNames(Arithmetic) {
  return {{{Arithmetic::kFloat32, "float32"}, {Arithmetic::kInteger, "integer"}}};
}

// Which ticks of a token attention in Arithmetic::kInteger takes together
// (docs/design/integer.md#attention): kByTick, as in float32, each at which the query fires and all
// others; kAllTicks, a model of its own for T > 1 in files of former releases, all of them.
enum class AttentionTicks { kByTick, kAllTicks };
constexpr std::array<EnumName<AttentionTicks>, 2> EnumNames(AttentionTicks) {
  return {{{AttentionTicks::kByTick, "shiftmax_by_tick"}, {AttentionTicks::kAllTicks, "shiftmax"}}};
}

struct ModelConfig {
  Mode mode = Mode::kFull;
  int hidden_size = 128;         // d
  int heads = 4;                 // H
  int layers = 2;                // L
  int ticks = 10;                // T
  int context = 20;              // N, timesteps
  int routing_hidden_size = 16;  // m
  int ffn_size = 512;            // 4d
  float membrane_decay = 0.95f;  // 1 - dt/tau_m
  float threshold = 1.0f;        // V_th
  PhaseClock phase_clock = PhaseClock::kTimestep;
  Merge merge = Merge::kSum;
  Gate gate = Gate::kSoftmax;
  NormKind norm = NormKind::kLayer;
  Arithmetic arithmetic = Arithmetic::kFloat32;
  // Whether the state token also contains the change of the observation since the timestep before.
  bool observation_changes = false;
  // The following belong to Arithmetic::kInteger.
  AttentionTicks attention = AttentionTicks::kByTick;
  int input_fraction = 8;      // fraction bits of the embeddings' inputs
  int residual_fraction = 10;  // fraction bits of the residual stream

  // Returns the number of inputs of the state embedding for observations of `observation_size`
  // numbers.
  int state_inputs(int observation_size) const {
    return observation_changes ? 2 * observation_size : observation_size;
  }
  int head_size() const { return hidden_size / heads; }  // d_h
  bool is_dense() const { return mode == Mode::kDense; }
  bool is_integer() const { return arithmetic == Arithmetic::kInteger; }
  // Returns the parts of a token's spikes that attention can separate in integers: 1, or T.
  int attention_planes() const { return attention == AttentionTicks::kByTick ? ticks : 1; }
  int plane_ticks() const { return ticks / attention_planes(); }
  bool has_norms() const { return norm == NormKind::kLayer; }
  bool has_phase() const { return mode == Mode::kPos || mode == Mode::kFull; }
  bool has_routing() const { return mode == Mode::kRoute || mode == Mode::kFull; }
  // Returns the number of inputs of the query, key and value projections: d, or d + H with phase
  // spikes (eq. 4.6).
  int attention_inputs() const { return hidden_size + (has_phase() ? heads : 0); }
  // Returns the factor of the gates: H for the softmax of concatenated heads, so that uniform gates
  // are 1, and 1 otherwise.
  int gate_factor() const {
    return has_routing() && merge == Merge::kConcat && gate == Gate::kSoftmax ? heads : 1;
  }
  // Returns the number of inputs of the attention's output projection: d_h, or d if the heads are
  // concatenated.
  int merged_size() const {
    return is_dense() || merge == Merge::kConcat ? hidden_size : head_size();
  }

  // Returns the m from 1 to 128 for which membrane_decay is 1 - m / 256, or 0 if there is none. A
  // membrane in Arithmetic::kInteger leaks V * m / 256.
  int leak() const;

  // Returns INVALID_ARGUMENT if a value is out of range. The message names the field, the expected
  // and the received value.
  absl::Status Validate() const;

  friend bool operator==(const ModelConfig&, const ModelConfig&) = default;
};

// The largest sizes that a policy may have. They bound the memory that a malicious file can
// allocate.
struct ModelLimits {
  static constexpr int kHiddenSize = 4096;
  static constexpr int kHeads = 64;
  static constexpr int kLayers = 64;
  static constexpr int kTicks = 256;
  static constexpr int kIntegerTicks = 255;  // with integers: a spike count takes a byte
  static constexpr int kContext = 4096;
  static constexpr int kRoutingHiddenSize = 4096;
  static constexpr int kFfnSize = 16384;
  static constexpr int kFraction = 14;  // bits
};

}  // namespace spikeserve
