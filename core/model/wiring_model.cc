#include "core/model/wiring_model.h"

#include <algorithm>
#include <cmath>

#include "absl/strings/str_cat.h"
#include "core/base/json.h"
#include "core/base/json_object.h"
#include "core/base/status_macros.h"
#include "core/math/portable.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

constexpr double kFreedom = 4.0;  // degrees of freedom of the errors
constexpr double kLargest = 1e9;  // of a factor, so that the product of 32 of them is a number

template <typename Model, typename Visitor>
void VisitNumbers(Model& model, Visitor&& visit) {
  visit("mean", model.mean);
  visit("deviation", model.deviation);
  visit("coefficients", model.coefficients);
  visit("variance", model.variance);
  visit("growth", model.growth);
}

absl::Status CheckNumbers(absl::string_view name, const std::vector<double>& numbers, size_t size,
                          double least) {
  if (numbers.size() != size) {
    return absl::InvalidArgumentError(
        absl::StrCat("wiring.", name, ": expected ", size, " numbers, received ", numbers.size()));
  }
  for (size_t i = 0; i < size; ++i) {
    if (std::isfinite(numbers[i]) && numbers[i] >= least) continue;
    return absl::InvalidArgumentError(absl::StrCat("wiring.", name, "[", i,
                                                   "]: expected a finite number of at least ",
                                                   least, ", received ", numbers[i]));
  }
  return absl::OkStatus();
}

}  // namespace

void FillWiringTerms(absl::Span<const double> z, absl::Span<const float> action,
                     absl::Span<double> terms) {
  double* term = terms.data();
  *term++ = 1.0;
  for (const double element : z) *term++ = element;
  for (const float element : action) *term++ = static_cast<double>(element);
  for (size_t i = 0; i < z.size(); ++i) {
    for (size_t j = i; j < z.size(); ++j) *term++ = z[i] * z[j];
  }
  for (const double element : z) {
    for (const float taken : action) *term++ = element * static_cast<double>(taken);
  }
}

void WiringModel::Predict(absl::Span<const double> before, absl::Span<const float> action,
                          absl::Span<double> terms, absl::Span<double> change) const {
  FillWiringTerms(before, action, terms);
  std::fill(change.begin(), change.end(), 0.0);
  const double* row = coefficients.data();
  for (const double term : terms) {
    for (size_t i = 0; i < change.size(); ++i) change[i] += term * row[i];
    row += change.size();
  }
}

double WiringModel::Surprise(absl::Span<const double> before, absl::Span<const double> after,
                             absl::Span<const double> change) const {
  const size_t obs = size();
  double spread = 0.0;
  for (const double element : before) spread += element * element;
  spread /= static_cast<double>(obs);
  const double cube = spread * spread * spread;
  double tails = 1.0;
  double scales = 1.0;
  for (size_t i = 0; i < obs; ++i) {
    const double error = (after[i] - before[i]) - change[i];
    const double scale = variance[i] + growth[i] * cube;
    tails *= std::min(1.0 + error * error / (kFreedom * scale), kLargest);
    scales *= std::min(scale / variance[i], kLargest);
  }
  return 0.5 * (kFreedom + 1.0) * portable::Log(tails) + 0.5 * portable::Log(scales);
}

double WiringModel::Distance(absl::Span<const double> z) const {
  double product = 1.0;
  for (const double element : z) product *= std::min(1.0 + element * element / 9.0, kLargest);
  return portable::Log(product);
}

absl::Status WiringModel::Validate(int observation_size, int action_size) const {
  const auto obs = static_cast<size_t>(observation_size);
  if (obs > kMostElements) {
    return absl::InvalidArgumentError(
        absl::StrCat("wiring: expected at most ", kMostElements, " elements, received ", obs));
  }
  constexpr double kSmallest = 1e-18;
  constexpr double kAny = -1e100;
  RETURN_IF_ERROR(CheckNumbers("mean", mean, obs, kAny));
  RETURN_IF_ERROR(CheckNumbers("deviation", deviation, obs, kSmallest));
  const size_t terms = Terms(obs, static_cast<size_t>(action_size));
  RETURN_IF_ERROR(CheckNumbers("coefficients", coefficients, terms * obs, kAny));
  RETURN_IF_ERROR(CheckNumbers("variance", variance, obs, kSmallest));
  RETURN_IF_ERROR(CheckNumbers("growth", growth, obs, 0.0));
  if (longest_run.size() != obs) {
    return absl::InvalidArgumentError(absl::StrCat("wiring.longest_run: expected ", obs,
                                                   " numbers, received ", longest_run.size()));
  }
  return CheckNumbers("usual_surprise", {usual_surprise}, 1, kAny);
}

absl::StatusOr<WiringModel> ParseWiringModel(absl::string_view text) {
  ASSIGN_OR_RETURN(const nlohmann::json object, ParseJsonObject("wiring", std::string(text)));
  WiringModel model;
  JsonObject reader("wiring", object);
  VisitNumbers(model, [&](const char* key, auto& numbers) { reader.Required(key, &numbers); });
  reader.Required("longest_run", &model.longest_run);
  reader.Required("usual_surprise", &model.usual_surprise);
  RETURN_IF_ERROR(reader.Finish());
  return model;
}

std::string FormatWiringModel(const WiringModel& model) {
  nlohmann::ordered_json object;
  VisitNumbers(model, [&](const char* key, const auto& numbers) { object[key] = numbers; });
  object["longest_run"] = model.longest_run;
  object["usual_surprise"] = model.usual_surprise;
  return object.dump();
}

}  // namespace spikeserve
