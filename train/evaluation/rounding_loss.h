// Measures what a policy lost when it was rounded, and decides whether that is too much.
//
// All functions are thread-safe.
#pragma once

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "core/dataset/dataset.h"
#include "core/model/policy.h"
#include "nlohmann/json.hpp"
#include "train/evaluation/paired_evaluation.h"

namespace spikeserve {

// What rounding cost, as shares of a range.
struct RoundingLoss {
  absl::string_view measure;  // "return" or "agreement"
  double range = 0.0;         // of the measure, which counts as 1
  MeanInterval loss;          // as a share of the range; a gain is negative
};

// Measures the return that `pair`, a policy before and after it was rounded, lost. The range is the
// distance of the policy's mean return from that of random actions on the same starts, at most 100.
// Errors are those of MakeEnvironment.
absl::StatusOr<RoundingLoss> LostReturn(const Policy& parent, const PairedEvaluation& pair);

// The same for returns that another program played: a JSON object with the returns of both on equal
// starts, `before` and `after`, and the mean one of random actions, `random`. INVALID_ARGUMENT if
// the text is none.
absl::StatusOr<RoundingLoss> ParseLostReturn(absl::string_view json);

// Measures how much less the rounded policy agrees with the recorded actions. Both policies observe
// the episodes without acting. A discrete action agrees or not; continuous ones agree by 1 minus
// their mean distance, as a share of the bounds' distance. REQUIRES: at least one episode, of the
// spaces of both policies.
RoundingLoss LostAgreement(const Policy& parent, const Policy& rounded,
                           absl::Span<const Episode> episodes);

// Returns whether the mean loss is larger than `largest`, and larger than chance explains at 95 %,
// which may explain any loss in one episode.
bool IsTooMuch(const RoundingLoss& loss, double largest);

// Returns FAILED_PRECONDITION, with `advice`, if IsTooMuch().
absl::Status CheckLoss(const RoundingLoss& loss, double largest, absl::string_view advice);

nlohmann::ordered_json ToJson(const RoundingLoss& loss);

// Returns, for example, "the integers lost 0.30 % of the range of the return (95 %: ...)".
std::string ToText(const RoundingLoss& loss);

}  // namespace spikeserve
