// The shape and the choices of one SNN-DT, as stored in a policy file.
//
// Plain values, safe to copy and to share between threads.
#ifndef CORE_MODEL_CONFIG_H_
#define CORE_MODEL_CONFIG_H_

#include <array>

#include "absl/status/status.h"
#include "core/base/enum_names.h"

namespace spikeserve {

// The paper's ablation (section 5.3), and an ordinary decision transformer for comparison.
enum class Mode { kBaseline, kPos, kRoute, kFull, kDense };

// How an analog vector becomes spikes: a constant current into LIF neurons, or Bernoulli draws.
enum class CoderKind { kLif, kBernoulli };

// The clock of the phase generators (eq. 4.4): kTimestep carries position, kWindow is the literal
// formula, which gives every token the same code.
enum class PhaseClock { kTimestep, kWindow };

// How the gated heads become one vector: their sum (eq. 4.11), or side by side.
enum class Merge { kSum, kConcat };

// How routing scores become gates: softmax over heads (eq. 4.10), or the appendix's sigmoid.
enum class Gate { kSoftmax, kSigmoid };

// Names as they stand in policy files and on command lines; see enum_names.h.
constexpr std::array<EnumName<Mode>, 5> EnumNames(Mode) {
  return {{{Mode::kBaseline, "baseline"},
           {Mode::kPos, "pos"},
           {Mode::kRoute, "route"},
           {Mode::kFull, "full"},
           {Mode::kDense, "dense"}}};
}
constexpr std::array<EnumName<CoderKind>, 2> EnumNames(CoderKind) {
  return {{{CoderKind::kLif, "lif"}, {CoderKind::kBernoulli, "bernoulli"}}};
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
  CoderKind coder = CoderKind::kLif;
  PhaseClock phase_clock = PhaseClock::kTimestep;
  Merge merge = Merge::kSum;
  Gate gate = Gate::kSoftmax;

  int head_size() const { return hidden_size / heads; }  // d_h
  bool is_dense() const { return mode == Mode::kDense; }
  bool has_phase() const { return mode == Mode::kPos || mode == Mode::kFull; }
  bool has_routing() const { return mode == Mode::kRoute || mode == Mode::kFull; }
  // Inputs of the query, key and value projections: d, or d + H with phase spikes (eq. 4.6).
  int attention_inputs() const { return hidden_size + (has_phase() ? heads : 0); }
  // Inputs of the attention's output projection: d_h, or d where heads stand side by side.
  int merged_size() const {
    return is_dense() || merge == Merge::kConcat ? hidden_size : head_size();
  }

  // INVALID_ARGUMENT names the field, what was expected and what came.
  absl::Status Validate() const;

  friend bool operator==(const ModelConfig&, const ModelConfig&) = default;
};

// The largest sizes a policy may ask for; they bound what a hostile file can allocate.
struct ModelLimits {
  static constexpr int kHiddenSize = 4096;
  static constexpr int kHeads = 64;
  static constexpr int kLayers = 64;
  static constexpr int kTicks = 256;
  static constexpr int kContext = 4096;
  static constexpr int kRoutingHiddenSize = 4096;
  static constexpr int kFfnSize = 16384;
};

}  // namespace spikeserve

#endif  // CORE_MODEL_CONFIG_H_
