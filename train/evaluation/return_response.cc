#include "train/evaluation/return_response.h"

#include <algorithm>
#include <memory>
#include <numeric>
#include <utility>

#include "absl/strings/str_format.h"
#include "core/base/rounded.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/math/vector_view.h"

namespace spikeserve {
namespace {

// Returns the rank of every value; tied values get the mean of their ranks.
std::vector<double> Ranks(absl::Span<const double> values) {
  std::vector<size_t> order(values.size());
  std::iota(order.begin(), order.end(), size_t{0});
  std::sort(order.begin(), order.end(), [&](size_t a, size_t b) { return values[a] < values[b]; });
  std::vector<double> ranks(values.size());
  for (size_t begin = 0, end = 0; begin < order.size(); begin = end) {
    while (end < order.size() && values[order[end]] == values[order[begin]]) ++end;
    for (size_t i = begin; i < end; ++i) ranks[order[i]] = static_cast<double>(begin + end - 1) / 2;
  }
  return ranks;
}

// Returns Pearson's correlation; 0 if x or y is constant.
double Correlation(absl::Span<const double> x, absl::Span<const double> y) {
  const Eigen::VectorXd a = AsVector(x).array() - AsVector(x).mean();
  const Eigen::VectorXd b = AsVector(y).array() - AsVector(y).mean();
  const double scale = a.norm() * b.norm();
  return scale > 0.0 ? a.dot(b) / scale : 0.0;
}

}  // namespace

double RankCorrelation(absl::Span<const double> x, absl::Span<const double> y) {
  SPIKESERVE_DCHECK_EQ(x.size(), y.size());
  return Correlation(Ranks(x), Ranks(y));
}

double ReturnResponse::rank_correlation() const {
  std::vector<double> x, y;
  for (size_t i = 0; i < asked.size(); ++i) {
    x.insert(x.end(), evaluations[i].returns.size(), asked[i]);
    y.insert(y.end(), evaluations[i].returns.begin(), evaluations[i].returns.end());
  }
  return RankCorrelation(x, y);
}

double ReturnResponse::mean_error() const {
  double sum = 0.0, count = 0.0;
  for (size_t i = 0; i < asked.size(); ++i) {
    const auto achieved = AsVector(evaluations[i].returns).array();
    sum += (achieved - asked[i]).abs().sum();
    count += static_cast<double>(achieved.size());
  }
  const auto [least, most] = std::minmax_element(asked.begin(), asked.end());
  return sum / count / (*most - *least);
}

absl::StatusOr<ReturnResponse> MeasureReturnResponse(const Policy& policy,
                                                     absl::Span<const double> asked,
                                                     const EvaluationOptions& options) {
  if (asked.empty() ||
      std::all_of(asked.begin(), asked.end(), [&](double value) { return value == asked[0]; })) {
    return absl::InvalidArgumentError("target_returns: expected two different ones at least");
  }
  ReturnResponse response = {.asked = {asked.begin(), asked.end()}, .evaluations = {}};
  for (const double target : asked) {
    auto asking = std::make_shared<Policy>(policy);
    asking->target_return = static_cast<float>(target);
    ASSIGN_OR_RETURN(Evaluation evaluation, Evaluate(std::move(asking), options));
    response.evaluations.push_back(std::move(evaluation));
  }
  return response;
}

nlohmann::ordered_json ToJson(const ReturnResponse& response) {
  nlohmann::ordered_json json = {{"rank_correlation", response.rank_correlation()},
                                 {"mean_error", response.mean_error()},
                                 {"targets", nlohmann::ordered_json::array()}};
  for (size_t i = 0; i < response.asked.size(); ++i) {
    const Evaluation& evaluation = response.evaluations[i];
    json["targets"].push_back({{"target_return", response.asked[i]},
                               {"mean_return", evaluation.mean_return()},
                               {"std_return", evaluation.std_return()},
                               {"spikes_per_decision", evaluation.spikes_per_decision()}});
  }
  return json;
}

std::string ToText(const ReturnResponse& response) {
  std::string text;
  for (size_t i = 0; i < response.asked.size(); ++i) {
    const Evaluation& evaluation = response.evaluations[i];
    text += absl::StrFormat("asked %.1f: return %.2f ± %.2f, spikes per decision %.1f\n",
                            response.asked[i], evaluation.mean_return(), evaluation.std_return(),
                            evaluation.spikes_per_decision());
  }
  return text + absl::StrFormat("rank correlation %.3f, mean error %.1f %% of the range asked\n",
                                Rounded(response.rank_correlation(), 3),
                                100.0 * response.mean_error());
}

}  // namespace spikeserve
