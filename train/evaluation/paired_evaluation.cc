#include "train/evaluation/paired_evaluation.h"

#include <cmath>
#include <limits>
#include <utility>

#include "absl/strings/str_format.h"
#include "core/base/rounded.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/math/vector_view.h"

namespace spikeserve {
namespace {

constexpr double kDeviations = 1.959964;  // half the width of a 95% interval of the normal

}  // namespace

std::vector<double> PairedEvaluation::differences() const {
  std::vector<double> differences;
  for (size_t i = 0; i < first.returns.size(); ++i) {
    differences.push_back(second.returns[i] - first.returns[i]);
  }
  return differences;
}

MeanInterval MeanWithInterval(const std::vector<double>& values) {
  SPIKESERVE_DCHECK(!values.empty());
  const auto count = static_cast<double>(values.size());
  const double mean = AsVector(values).mean();
  const double squares = (AsVector(values).array() - mean).square().sum();
  const double variance =
      count > 1.0 ? squares / (count - 1.0) : std::numeric_limits<double>::infinity();
  const double margin = kDeviations * std::sqrt(variance / count);
  return {.mean = mean, .low = mean - margin, .high = mean + margin};
}

absl::StatusOr<PairedEvaluation> EvaluatePair(std::shared_ptr<const Policy> first,
                                              std::shared_ptr<const Policy> second,
                                              const EvaluationOptions& options) {
  ASSIGN_OR_RETURN(Evaluation a, Evaluate(std::move(first), options));
  ASSIGN_OR_RETURN(Evaluation b, Evaluate(std::move(second), options));
  return PairedEvaluation{.first = std::move(a), .second = std::move(b)};
}

nlohmann::ordered_json ToJson(const PairedEvaluation& pair) {
  const MeanInterval difference = MeanWithInterval(pair.differences());
  return {
      {"environment", pair.first.environment},
      {"episodes", pair.first.options.episodes},
      {"first_seed", pair.first.options.first_seed},
      {"mean_returns", {pair.first.mean_return(), pair.second.mean_return()}},
      {"mean_difference", difference.mean},
      {"difference_95_percent", {difference.low, difference.high}},
      {"spikes_per_decision",
       {pair.first.spikes_per_decision(), pair.second.spikes_per_decision()}},
  };
}

std::string ToText(const PairedEvaluation& pair, absl::string_view first,
                   absl::string_view second) {
  const MeanInterval difference = MeanWithInterval(pair.differences());
  const double before = pair.first.spikes_per_decision();
  const double after = pair.second.spikes_per_decision();
  std::string text = absl::StrFormat(
      "%s, %d episodes from seed %d\n"
      "return %.2f %s, %.2f %s; difference %.3f (%s)\n",
      pair.first.environment, pair.first.options.episodes, pair.first.options.first_seed,
      pair.first.mean_return(), first, pair.second.mean_return(), second,
      Rounded(difference.mean, 3),
      difference.is_bounded()
          ? absl::StrFormat("95%% interval %.3f to %.3f", Rounded(difference.low, 3),
                            Rounded(difference.high, 3))
          : "one episode has no interval");
  if (before == 0.0) return text;  // a dense policy
  absl::StrAppendFormat(&text, "spikes per decision %.1f %s, %.1f %s (%+.2f%%)\n", before, first,
                        after, second, 100.0 * (after / before - 1.0));
  return text;
}

}  // namespace spikeserve
