// One bounded step of an action head: eq. 4.3 with its guards.
//
// A free function, safe to call from many threads.
#ifndef CORE_LEARNING_HEAD_UPDATE_H_
#define CORE_LEARNING_HEAD_UPDATE_H_

#include <array>
#include <vector>

#include "absl/types/span.h"
#include "core/base/enum_names.h"

namespace spikeserve {

enum class UpdateOutcome {
  kApplied,
  kNonFinite,  // refused: the step, or the head after it, holds NaN or infinity
};

constexpr std::array<EnumName<UpdateOutcome>, 2> EnumNames(UpdateOutcome) {
  return {{{UpdateOutcome::kApplied, "applied"}, {UpdateOutcome::kNonFinite, "non_finite"}}};
}

struct UpdateBounds {
  double clip = 0.5;      // a longer step is shortened to this Frobenius norm
  double max_norm = 1.0;  // a longer delta is shortened to this Frobenius norm after the step
};

// delta <- delta + factor * direction (eq. 4.3: factor eta delta_t, direction E), both [outputs,
// d]. A refused step leaves `delta` as it was. A head beyond max_norm may still be led back.
UpdateOutcome ApplyUpdate(double factor, absl::Span<const double> direction,
                          const UpdateBounds& bounds, std::vector<float>* delta);

}  // namespace spikeserve

#endif  // CORE_LEARNING_HEAD_UPDATE_H_
