// Compares two policies on the same starts of their environment.
#pragma once

#include <cmath>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/model/policy.h"
#include "nlohmann/json.hpp"
#include "train/evaluation/evaluation.h"

namespace spikeserve {

// The evaluations of two policies, whose episodes with equal numbers have equal starts.
struct PairedEvaluation {
  Evaluation first;
  Evaluation second;

  // Returns the differences of the returns, second minus first, per episode.
  std::vector<double> differences() const;
};

// A mean with its 95% confidence interval, by the normal approximation. The ends are infinite, in
// JSON null, if there is only one value, which shows no spread.
struct MeanInterval {
  double mean = 0.0;
  double low = 0.0;
  double high = 0.0;

  bool is_bounded() const { return std::isfinite(high); }
};

// Returns the mean of `values` and its interval. REQUIRES: at least one value.
MeanInterval MeanWithInterval(const std::vector<double>& values);

// Plays both policies as Evaluate does. Errors are those of Evaluate.
absl::StatusOr<PairedEvaluation> EvaluatePair(std::shared_ptr<const Policy> first,
                                              std::shared_ptr<const Policy> second,
                                              const EvaluationOptions& options);

// Converts the comparison, without the evaluations, to JSON: episodes, first_seed, the mean returns
// and spikes per decision of both, and the mean difference of the returns with its interval.
nlohmann::ordered_json ToJson(const PairedEvaluation& pair);

// Formats the comparison as text for the terminal, with a name for each policy.
std::string ToText(const PairedEvaluation& pair, absl::string_view first, absl::string_view second);

}  // namespace spikeserve
