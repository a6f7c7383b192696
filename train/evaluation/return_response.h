// Measures how the achieved return follows the target return that a policy is conditioned on.
#pragma once

#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/model/policy.h"
#include "nlohmann/json.hpp"
#include "train/evaluation/evaluation.h"

namespace spikeserve {

struct ReturnResponse {
  std::vector<double> asked;            // the target returns
  std::vector<Evaluation> evaluations;  // one per target return

  // Returns Spearman's rank correlation between target and achieved return over all episodes; 0 if
  // either is constant.
  double rank_correlation() const;
  // Returns the mean of |achieved - target| over all episodes, divided by the range of the targets.
  double mean_error() const;
};

// Plays episodes from the same seeds for every target return in `asked`. Returns INVALID_ARGUMENT
// for fewer than two different targets, or an error of Evaluate.
absl::StatusOr<ReturnResponse> MeasureReturnResponse(const Policy& policy,
                                                     absl::Span<const double> asked,
                                                     const EvaluationOptions& options);

// Returns Spearman's rank correlation; tied values get the mean of their ranks. REQUIRES: x and y
// have the same length.
double RankCorrelation(absl::Span<const double> x, absl::Span<const double> y);

nlohmann::ordered_json ToJson(const ReturnResponse& response);
std::string ToText(const ReturnResponse& response);

}  // namespace spikeserve
