// One bounded step of an action head (eq. 4.3).
//
// Free functions, safe to call from many threads.
#pragma once

#include <array>

#include "Eigen/Core"
#include "core/base/enum_names.h"

namespace spikeserve {

enum class UpdateOutcome {
  kApplied,
  kNonFinite,   // refused: the step, or the head after it, holds NaN or infinity
  kOverBudget,  // refused: the contributor exceeds its share of a shared head
  kHeldOut,     // refused: the session judges a shared head and contributes nothing to it
};

constexpr std::array<EnumName<UpdateOutcome>, 4> EnumNames(UpdateOutcome) {
  return {{{UpdateOutcome::kApplied, "applied"},
           {UpdateOutcome::kNonFinite, "non_finite"},
           {UpdateOutcome::kOverBudget, "over_budget"},
           {UpdateOutcome::kHeldOut, "held_out"}}};
}

// Returns true if a shared head has refused all updates of an episode because of where they come
// from.
constexpr bool IsRefusedByFleet(UpdateOutcome outcome) {
  return outcome == UpdateOutcome::kOverBudget || outcome == UpdateOutcome::kHeldOut;
}

// The longest Frobenius norm of W - W_base, so that the logits of readouts in [0, 1] are finite in
// float32.
inline constexpr double kLongestHeadDelta = 1e30;

struct UpdateBounds {
  double clip = 0.5;  // largest Frobenius norm of one step; a longer step is scaled to it
  // Largest Frobenius norm of delta after the step, at most kLongestHeadDelta; scaled likewise.
  double max_norm = 1.0;
};

// Computes delta <- delta + factor * direction within `bounds`. `direction` and `delta` are flat
// [act * d] arrays; in eq. 4.3 `factor` is eta delta_t and `direction` is E. A refused step leaves
// `delta` unchanged. Allocates no memory.
UpdateOutcome ApplyUpdate(double factor, const Eigen::VectorXf& direction,
                          const UpdateBounds& bounds, Eigen::VectorXf* delta);
UpdateOutcome ApplyUpdate(double factor, const Eigen::VectorXd& direction,
                          const UpdateBounds& bounds, Eigen::VectorXf* delta);

}  // namespace spikeserve
