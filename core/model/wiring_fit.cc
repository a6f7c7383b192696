#include "core/model/wiring_fit.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

constexpr double kRidge = 1e-3;
constexpr double kFloor = 0.02;        // least scale of the errors, of the changes
constexpr double kErrorFreedom = 4.0;  // as in wiring_model.cc
constexpr int kRefinements = 40;
constexpr double kUsual = 0.9;  // share of the steps with less than the usual surprise

using Matrix = std::vector<double>;  // row-major

// Solves (A + ridge) X = B by Cholesky's method, in place: `b` [n, columns] becomes X. REQUIRES:
// `a` [n, n] is symmetric and positive semidefinite.
void Solve(size_t n, size_t columns, Matrix a, Matrix* b) {
  for (size_t i = 0; i < n; ++i) a[i * n + i] += kRidge;
  for (size_t j = 0; j < n; ++j) {
    for (size_t i = j; i < n; ++i) {
      double sum = a[i * n + j];
      for (size_t k = 0; k < j; ++k) sum -= a[i * n + k] * a[j * n + k];
      a[i * n + j] = i == j ? std::sqrt(std::max(sum, kRidge * kRidge)) : sum / a[j * n + j];
    }
  }
  for (size_t c = 0; c < columns; ++c) {
    const auto x = [&](size_t i) -> double& { return (*b)[i * columns + c]; };
    for (size_t i = 0; i < n; ++i) {
      for (size_t k = 0; k < i; ++k) x(i) -= a[i * n + k] * x(k);
      x(i) /= a[i * n + i];
    }
    for (size_t i = n; i-- > 0;) {
      for (size_t k = i + 1; k < n; ++k) x(i) -= a[k * n + i] * x(k);
      x(i) /= a[i * n + i];
    }
  }
}

// Returns variance and growth of squared errors `e` at cubed spreads `g`: weighted least squares of
// e = variance + growth g, in which errors far from it weigh less.
std::pair<double, double> FitScale(const std::vector<double>& e, const std::vector<double>& g) {
  std::vector<double> sorted = e;
  std::nth_element(sorted.begin(), sorted.begin() + static_cast<int64_t>(e.size() / 2),
                   sorted.end());
  double variance = sorted[e.size() / 2] + 1e-12;
  double growth = 0.0;
  for (int i = 0; i < kRefinements; ++i) {
    double w11 = 0.0, w1g = 0.0, wgg = 0.0, w1e = 0.0, wge = 0.0;
    for (size_t t = 0; t < e.size(); ++t) {
      const double scale = variance + growth * g[t];
      const double error = (kErrorFreedom + 1.0) / (kErrorFreedom + e[t] / scale) * e[t];
      const double weight = 1.0 / (scale * scale);
      w11 += weight;
      w1g += weight * g[t];
      wgg += weight * g[t] * g[t];
      w1e += weight * error;
      wge += weight * g[t] * error;
    }
    const double determinant = w11 * wgg - w1g * w1g;
    if (!(determinant > 1e-12 * w11 * wgg)) {  // all spreads are equal
      variance = std::max(w1e / w11, 1e-12);
      continue;
    }
    growth = std::max((w11 * wge - w1g * w1e) / determinant, 0.0);
    variance = std::max((wgg * w1e - w1g * wge) / determinant, 1e-12);
  }
  return {variance, growth};
}

// The steps in standard units: z [count, obs], their changes [count, obs], and actions [count,
// act].
struct StandardSteps {
  size_t obs, act, count;
  absl::Span<const float> actions;
  Matrix z, change;

  absl::Span<const double> Now(size_t t) const {
    return absl::MakeConstSpan(z).subspan(t * obs, obs);
  }
  absl::Span<const float> Action(size_t t) const { return actions.subspan(t * act, act); }
};

// Sets mean and deviation of `model` to those of `before` [count, obs].
void FitStandard(absl::Span<const double> before, size_t obs, WiringModel* model) {
  const auto n = static_cast<double>(before.size() / obs);
  model->mean.assign(obs, 0.0);
  model->deviation.assign(obs, 0.0);
  for (size_t t = 0; t < before.size(); ++t) model->mean[t % obs] += before[t] / n;
  for (size_t t = 0; t < before.size(); ++t) {
    const double distance = before[t] - model->mean[t % obs];
    model->deviation[t % obs] += distance * distance / n;
  }
  for (double& deviation : model->deviation) deviation = std::sqrt(deviation) + 1e-6;
}

// Sets the coefficients of `model` to the solution of the normal equations.
void FitPrediction(const StandardSteps& steps, WiringModel* model) {
  const size_t terms = WiringModel::Terms(steps.obs, steps.act);
  Matrix squares(terms * terms, 0.0), row(terms);
  model->coefficients.assign(terms * steps.obs, 0.0);
  for (size_t t = 0; t < steps.count; ++t) {
    FillWiringTerms(steps.Now(t), steps.Action(t), absl::MakeSpan(row));
    for (size_t i = 0; i < terms; ++i) {
      for (size_t j = 0; j <= i; ++j) squares[i * terms + j] += row[i] * row[j];
      for (size_t k = 0; k < steps.obs; ++k) {
        model->coefficients[i * steps.obs + k] += row[i] * steps.change[t * steps.obs + k];
      }
    }
  }
  for (size_t i = 0; i < terms; ++i) {
    for (size_t j = i + 1; j < terms; ++j) squares[i * terms + j] = squares[j * terms + i];
  }
  Solve(terms, steps.obs, std::move(squares), &model->coefficients);
}

// Sets variance and growth of `model` to those of the errors of its prediction.
void FitScales(const StandardSteps& steps, WiringModel* model) {
  const auto n = static_cast<double>(steps.count);
  std::vector<Matrix> errors(steps.obs, Matrix(steps.count));
  Matrix cubes(steps.count), changes(steps.obs, 0.0);
  Matrix row(WiringModel::Terms(steps.obs, steps.act));
  for (size_t t = 0; t < steps.count; ++t) {
    FillWiringTerms(steps.Now(t), steps.Action(t), absl::MakeSpan(row));
    double spread = 0.0;
    for (size_t i = 0; i < steps.obs; ++i) {
      double error = steps.change[t * steps.obs + i];
      changes[i] += error * error / n;
      for (size_t k = 0; k < row.size(); ++k) {
        error -= row[k] * model->coefficients[k * steps.obs + i];
      }
      errors[i][t] = error * error;
      spread += steps.Now(t)[i] * steps.Now(t)[i];
    }
    spread /= static_cast<double>(steps.obs);
    cubes[t] = spread * spread * spread;
  }
  for (size_t i = 0; i < steps.obs; ++i) {
    const auto [variance, growth] = FitScale(errors[i], cubes);
    model->variance.push_back(std::max(variance, kFloor * kFloor * std::max(changes[i], 1e-6)));
    model->growth.push_back(growth);
  }
}

// Returns the surprise that a share kUsual of the steps does not reach.
double UsualSurprise(const StandardSteps& steps, const WiringModel& model) {
  Matrix surprises(steps.count), after(steps.obs), change(steps.obs);
  Matrix row(WiringModel::Terms(steps.obs, steps.act));
  for (size_t t = 0; t < steps.count; ++t) {
    for (size_t i = 0; i < steps.obs; ++i) {
      after[i] = steps.Now(t)[i] + steps.change[t * steps.obs + i];
    }
    model.Predict(steps.Now(t), steps.Action(t), absl::MakeSpan(row), absl::MakeSpan(change));
    surprises[t] = model.Surprise(steps.Now(t), after, change);
  }
  const auto usual = static_cast<int64_t>(kUsual * static_cast<double>(steps.count));
  std::nth_element(surprises.begin(), surprises.begin() + usual, surprises.end());
  return surprises[static_cast<size_t>(usual)];
}

}  // namespace

WiringFit::WiringFit(size_t observation_size, size_t action_size)
    : obs_(observation_size), act_(action_size), longest_run_(observation_size, 0) {}

void WiringFit::Add(absl::Span<const float> observations, absl::Span<const float> actions) {
  SPIKESERVE_DCHECK_EQ(observations.size() / obs_, actions.size() / act_ + 1);
  std::vector<int64_t> run(obs_, 0);
  for (size_t t = 0; t < actions.size() / act_; ++t) {
    if (before_.size() / obs_ >= kMostSteps) return;
    const auto now = observations.subspan(t * obs_, obs_);
    const auto next = observations.subspan((t + 1) * obs_, obs_);
    if (!std::all_of(next.begin(), next.end(), [](float x) { return std::isfinite(x); })) return;
    before_.insert(before_.end(), now.begin(), now.end());
    after_.insert(after_.end(), next.begin(), next.end());
    const auto action = actions.subspan(t * act_, act_);
    actions_.insert(actions_.end(), action.begin(), action.end());
    for (size_t i = 0; i < obs_; ++i) {
      run[i] = now[i] == next[i] ? run[i] + 1 : 0;
      longest_run_[i] = std::max(longest_run_[i], run[i]);
    }
  }
}

absl::StatusOr<WiringModel> WiringFit::Finish() const {
  const size_t steps = before_.size() / obs_;
  const size_t terms = WiringModel::Terms(obs_, act_);
  if (obs_ > WiringModel::kMostElements || steps < 2 * terms) {
    return absl::FailedPreconditionError(absl::StrCat(
        "data: expected at most ", WiringModel::kMostElements, " elements and at least ", 2 * terms,
        " steps, received ", obs_, " elements and ", steps, " steps"));
  }
  WiringModel model;
  model.longest_run = longest_run_;
  FitStandard(before_, obs_, &model);
  StandardSteps standard = {
      obs_, act_, steps, actions_, Matrix(steps * obs_), Matrix(steps * obs_)};
  for (size_t t = 0; t < steps * obs_; ++t) {
    const size_t i = t % obs_;
    standard.z[t] = (before_[t] - model.mean[i]) / model.deviation[i];
    standard.change[t] = (after_[t] - model.mean[i]) / model.deviation[i] - standard.z[t];
  }
  FitPrediction(standard, &model);
  FitScales(standard, &model);
  model.usual_surprise = UsualSurprise(standard, model);
  return model;
}

}  // namespace spikeserve
