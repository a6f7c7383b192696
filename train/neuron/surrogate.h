// Surrogate gradients: functions that replace the derivative of the spike's step function in the
// backward pass.
//
// Pure functions; safe to call from many threads.
#pragma once

#include <array>
#include <cmath>

#include "core/base/enum_names.h"
#include "core/math/exp.h"

namespace spikeserve {

// ds/du at u = V - V_th (the paper's section "surrogate gradients"); k is the slope:
//   fast sigmoid      1 / (1 + k |u|)^2
//   sigmoid           f (1 - f), f = 1 / (1 + e^{-k u})
//   piecewise linear  max(0, 1 - k |u|)
enum class SurrogateKind { kFastSigmoid, kSigmoid, kPiecewiseLinear };

constexpr std::array<EnumName<SurrogateKind>, 3> EnumNames(SurrogateKind) {
  return {{{SurrogateKind::kFastSigmoid, "fast_sigmoid"},
           {SurrogateKind::kSigmoid, "sigmoid"},
           {SurrogateKind::kPiecewiseLinear, "piecewise_linear"}}};
}

struct Surrogate {
  SurrogateKind kind = SurrogateKind::kFastSigmoid;
  float slope = 10.0f;  // k > 0
};

inline float FastSigmoidDerivative(float slope, float u) {
  const float d = 1.0f + slope * std::abs(u);
  return 1.0f / (d * d);
}

inline float SigmoidDerivative(float slope, float u) {
  const float f = Sigmoid(slope * u);
  return f * (1.0f - f);
}

inline float PiecewiseLinearDerivative(float slope, float u) {
  const float d = 1.0f - slope * std::abs(u);
  return d > 0.0f ? d : 0.0f;
}

// Calls `body(derivative)` with the function u -> ds/du of this surrogate, so that a loop over many
// neurons selects the kind once and not once per neuron. Example:
//   WithDerivative(surrogate, [&](auto derivative) {
//     for (float& value : values) value = derivative(value);
//   });
template <typename Body>
inline __attribute__((always_inline)) void WithDerivative(const Surrogate& surrogate, Body&& body) {
  const float k = surrogate.slope;
  switch (surrogate.kind) {
    case SurrogateKind::kFastSigmoid:
      return body([k](float u) { return FastSigmoidDerivative(k, u); });
    case SurrogateKind::kSigmoid:
      return body([k](float u) { return SigmoidDerivative(k, u); });
    case SurrogateKind::kPiecewiseLinear:
      return body([k](float u) { return PiecewiseLinearDerivative(k, u); });
  }
}

}  // namespace spikeserve
