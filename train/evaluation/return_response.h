// How the return that is achieved follows the return that is asked for.
#ifndef TRAIN_EVALUATION_RETURN_RESPONSE_H_
#define TRAIN_EVALUATION_RETURN_RESPONSE_H_

#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/model/policy.h"
#include "nlohmann/json.hpp"
#include "train/evaluation/evaluation.h"

namespace spikeserve {

struct ReturnResponse {
  std::vector<double> asked;
  std::vector<Evaluation> evaluations;  // one for each return asked for

  // Spearman's, between asked and achieved over all episodes; 0 where either never varies.
  double rank_correlation() const;
  // Mean over all episodes of |achieved - asked|, as a share of the range of what was asked.
  double mean_error() const;
};

// Plays the same starts for every return in `asked`. INVALID_ARGUMENT for fewer than two different
// ones, or as Evaluate.
absl::StatusOr<ReturnResponse> MeasureReturnResponse(const Policy& policy,
                                                     absl::Span<const double> asked,
                                                     const EvaluationOptions& options);

// Spearman's rank correlation; ties share the mean of their ranks. REQUIRES: equal lengths.
double RankCorrelation(absl::Span<const double> x, absl::Span<const double> y);

nlohmann::ordered_json ToJson(const ReturnResponse& response);
std::string ToText(const ReturnResponse& response);

}  // namespace spikeserve

#endif  // TRAIN_EVALUATION_RETURN_RESPONSE_H_
