#include "core/model/wiring_model.h"

#include <algorithm>
#include <cmath>

#include "absl/strings/str_cat.h"
#include "core/base/fields.h"
#include "core/base/json.h"
#include "core/base/json_object.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/math/portable.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

constexpr double kFreedom = 4.0;  // degrees of freedom of the errors
constexpr double kLargest = 1e9;  // of a factor, so that the product of 32 of them is a number

SPIKESERVE_FIELDS(WiringModel, mean, deviation, coefficients, variance, growth, longest_run,
                  usual_surprise)

absl::Status CheckNumbers(absl::string_view name, const std::vector<double>& numbers, size_t size,
                          double least) {
  if (numbers.size() != size) {
    return InvalidArgument(absl::StrCat("wiring.", name), absl::StrCat(size, " numbers"),
                           numbers.size());
  }
  for (size_t i = 0; i < size; ++i) {
    if (std::isfinite(numbers[i]) && numbers[i] >= least) continue;
    return InvalidArgument(absl::StrCat("wiring.", name, "[", i, "]"),
                           absl::StrCat("a finite number of at least ", least), numbers[i]);
  }
  return absl::OkStatus();
}

void AddRow(double factor, const double* row, absl::Span<double> sums) {
  for (size_t i = 0; i < sums.size(); ++i) sums[i] += factor * row[i];
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
  constexpr size_t kTogether = 4;  // rows that are added in one pass over `change`
  double factors[kTogether];
  const double* rows[kTogether];
  size_t collected = 0;
  for (size_t k = 0; k < terms.size(); ++k) {
    if (terms[k] == 0.0) continue;  // as most elements of an action that is one of several
    factors[collected] = terms[k];
    rows[collected] = coefficients.data() + k * change.size();
    if (++collected < kTogether) continue;
    collected = 0;
    for (size_t i = 0; i < change.size(); ++i) {
      change[i] = (((change[i] + factors[0] * rows[0][i]) + factors[1] * rows[1][i]) +
                   factors[2] * rows[2][i]) +
                  factors[3] * rows[3][i];
    }
  }
  for (size_t k = 0; k < collected; ++k) AddRow(factors[k], rows[k], change);
}

void WiringModel::FillSlopes(absl::Span<const double> before, absl::Span<const float> action,
                             absl::Span<double> slopes) const {
  const size_t obs = size();
  const auto of = [&](size_t element) { return slopes.subspan(element * obs, obs); };
  const double* row = coefficients.data() + obs;
  std::copy(row, row + obs * obs, slopes.begin());
  row += (obs + action.size()) * obs;
  for (size_t i = 0; i < obs; ++i) {
    for (size_t j = i; j < obs; ++j, row += obs) {
      AddRow(before[j], row, of(i));
      AddRow(before[i], row, of(j));
    }
  }
  for (size_t i = 0; i < obs; ++i) {
    for (const float taken : action) {
      if (taken != 0.0f) AddRow(static_cast<double>(taken), row, of(i));
      row += obs;
    }
  }
}

void WiringModel::AddMoves(absl::Span<const double> slopes, absl::Span<const Move> moves,
                           absl::Span<double> change) const {
  const size_t obs = size();
  const size_t squares = obs * (obs + 1) / 2;
  const size_t act = (coefficients.size() / obs - squares - obs - 1) / (obs + 1);
  for (size_t k = 0; k < moves.size(); ++k) {
    const auto [i, by] = moves[k];
    AddRow(by, slopes.data() + i * obs, change);
    // The square of i is the first of its products, which stand behind those of lower elements.
    const size_t square = 1 + obs + act + squares - (obs - i) * (obs - i + 1) / 2;
    for (const Move& other : moves.subspan(k)) {
      const size_t product = square + (other.element - i);
      AddRow(by * other.by, coefficients.data() + product * obs, change);
    }
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
  static_assert(kFreedom == 4.0);
  const double product = tails * tails * tails * tails * tails * scales;
  if (product < 1e300) return 0.5 * portable::Log(product);
  return 0.5 * ((kFreedom + 1.0) * portable::Log(tails) + portable::Log(scales));
}

double WiringModel::Spread(absl::Span<const double> z) const {
  double product = 1.0;
  for (const double element : z) {
    product *= std::min(1.0 + element * element * (1.0 / 9.0), kLargest);
  }
  return product;
}

absl::Status WiringModel::Validate(int observation_size, int action_size) const {
  const auto obs = static_cast<size_t>(observation_size);
  if (obs > kMostElements) {
    return InvalidArgument("wiring", absl::StrCat("at most ", kMostElements, " elements"), obs);
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
    return InvalidArgument("wiring.longest_run", absl::StrCat(obs, " numbers"), longest_run.size());
  }
  return CheckNumbers("usual_surprise", {usual_surprise}, 1, kAny);
}

absl::StatusOr<WiringModel> ParseWiringModel(absl::string_view text) {
  ASSIGN_OR_RETURN(const nlohmann::json object, ParseJsonObject("wiring", std::string(text)));
  WiringModel model;
  JsonObject reader("wiring", object);
  VisitFields(model, [&](const char* key, auto& numbers) { reader.Required(key, &numbers); });
  RETURN_IF_ERROR(reader.Finish());
  return model;
}

std::string FormatWiringModel(const WiringModel& model) {
  nlohmann::ordered_json object;
  VisitFields(model, [&](const char* key, const auto& numbers) { object[key] = numbers; });
  return object.dump();
}

}  // namespace spikeserve
