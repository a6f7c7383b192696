#include "core/agent/wiring_check.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/contract/dcheck.h"
#include "core/model/features.h"

namespace spikeserve {
namespace {

// Chosen with a prototype in NumPy, on recorded episodes of the shipped tasks.
constexpr double kEnough = 25.0;         // evidence for a verdict
constexpr double kMost = 50.0;           // evidence that is kept, so that it can be withdrawn
constexpr double kStep = 8.0;            // most evidence of one step
constexpr double kContradicted = -30.0;  // total at which a hypothesis is given up
constexpr double kSimilar = 0.5;         // share of the best evidence that may name the cause
constexpr double kUnusualStep = 4.0;     // most evidence of one step against all wirings
constexpr double kUnusual = 120.0;       // that evidence for a verdict
constexpr int64_t kWindow = 50;          // steps of a window
constexpr int64_t kPause = 1000;         // steps between two windows of one episode
constexpr int64_t kStuckSteps = 50;
constexpr double kImplausible = 4.0;  // deviations from the mean from which a unit is wrong
constexpr double kDegree = std::numbers::pi / 180.0;
constexpr double kLogOfDegree = 4.048223198220452;  // -ln(pi / 180)

bool MayBeAngle(const Features& features, size_t element) {
  if (element >= features.observation.size()) return true;
  const std::string& unit = features.observation[element].unit;
  return unit.empty() || unit.starts_with("rad");
}

}  // namespace

WiringCheck::WiringCheck(const Policy& policy)
    : policy_(policy), model_(policy.wiring), runs_(model_->size(), 0) {}

void WiringCheck::BeginEpisode() {
  before_.clear();
  action_before_.clear();
  std::fill(runs_.begin(), runs_.end(), 0);
  if (!verdict_.has_value() && !is_open_) OpenWindow();
}

void WiringCheck::OpenWindow() {
  hypotheses_.clear();
  const size_t obs = model_->size();
  for (size_t i = 0; i < obs; ++i) {
    for (size_t j = i + 1; j < obs; ++j) {
      hypotheses_.push_back({.cause = WiringCause::kExchanged, .i = i, .j = j});
    }
  }
  for (size_t i = 0; i < obs; ++i) hypotheses_.push_back({.cause = WiringCause::kSign, .i = i});
  for (size_t i = 0; i < obs; ++i) {
    if (!MayBeAngle(policy_.features, i)) continue;
    hypotheses_.push_back({.cause = WiringCause::kUnit, .i = i});
  }
  hypotheses_.push_back({.cause = WiringCause::kDelay});
  unusual_ = 0.0;
  window_steps_ = 0;
  is_open_ = true;
}

bool WiringCheck::OnStep(absl::Span<const float> observation, absl::Span<const float> action) {
  SPIKESERVE_DCHECK_EQ(observation.size(), model_->size());
  const bool had_verdict = verdict_.has_value();
  if (action.empty()) before_.clear();
  if (!before_.empty()) {
    CountRuns(observation);
    if (!is_open_ && --steps_until_window_ <= 0) OpenWindow();
    if (is_open_) Compare(observation, action);
  }
  action_before_.assign(action.begin(), action.end());
  before_.assign(observation.begin(), observation.end());
  return verdict_.has_value() && !had_verdict;
}

void WiringCheck::Compare(absl::Span<const float> observation, absl::Span<const float> action) {
  const Fit trained = Explain(nullptr, observation, action);
  const double excess = trained.surprise - model_->usual_surprise;
  double least = trained.surprise;
  for (Hypothesis& each : hypotheses_) {
    if (each.cause == WiringCause::kDelay && action_before_.empty()) continue;
    const Fit fit = Explain(&each, observation, action);
    double gain = trained.surprise - fit.surprise;
    if (gain > 0.0 && !IsPlausible(each, observation)) gain = 0.0;
    least = std::min(least, fit.surprise);
    const double farther = std::max(0.0, fit.distance - trained.distance);
    each.total += gain - farther;
    if (gain > 0.0) {
      const double misfit = std::max(0.0, fit.surprise - model_->usual_surprise);
      gain = std::min(gain - misfit - farther, std::max(0.0, excess));
    }
    each.evidence = std::clamp(each.evidence + std::clamp(gain, -kStep, kStep), 0.0, kMost);
  }
  unusual_ += std::clamp(least - model_->usual_surprise, -kUnusualStep, kUnusualStep);
  unusual_ = std::clamp(unusual_, 0.0, 2.0 * kUnusual);
  ++window_steps_;
  Judge();
}

WiringCheck::Fit WiringCheck::Explain(const Hypothesis* hypothesis,
                                      absl::Span<const float> observation,
                                      absl::Span<const float> action) const {
  const size_t obs = model_->size();
  thread_local std::vector<double> memory;
  const size_t terms = WiringModel::Terms(obs, action.size());
  memory.resize(terms + 3 * obs);
  const auto all = absl::MakeSpan(memory);
  const auto before = all.subspan(0, obs);
  const auto after = all.subspan(obs, obs);
  for (size_t i = 0; i < obs; ++i) {
    before[i] = static_cast<double>(before_[i]);
    after[i] = static_cast<double>(observation[i]);
  }
  double constant = 0.0;
  const auto wire = [&](absl::Span<double> x) {
    if (hypothesis->cause == WiringCause::kExchanged) std::swap(x[hypothesis->i], x[hypothesis->j]);
    if (hypothesis->cause == WiringCause::kSign) x[hypothesis->i] = -x[hypothesis->i];
    if (hypothesis->cause == WiringCause::kUnit) x[hypothesis->i] *= kDegree;
  };
  if (hypothesis != nullptr) {
    wire(before);
    wire(after);
    if (hypothesis->cause == WiringCause::kUnit) constant = kLogOfDegree;
    if (hypothesis->cause == WiringCause::kDelay) action = action_before_;
  }
  for (size_t i = 0; i < obs; ++i) {
    before[i] = (before[i] - model_->mean[i]) / model_->deviation[i];
    after[i] = (after[i] - model_->mean[i]) / model_->deviation[i];
  }
  const double surprise = model_->Surprise(before, after, action, all.subspan(3 * obs, terms),
                                           all.subspan(2 * obs, obs));
  return {constant + surprise, model_->Distance(after)};
}

bool WiringCheck::IsPlausible(const Hypothesis& hypothesis,
                              absl::Span<const float> observation) const {
  if (hypothesis.cause != WiringCause::kUnit) return true;
  const size_t i = hypothesis.i;
  const auto distance = [&](float value) {
    return std::abs(static_cast<double>(value) - model_->mean[i]) / model_->deviation[i];
  };
  return std::max(distance(before_[i]), distance(observation[i])) > kImplausible;
}

void WiringCheck::Judge() {
  double most = 0.0;
  for (const Hypothesis& each : hypotheses_) most = std::max(most, each.evidence);
  const bool is_wiring = verdict_.has_value() && verdict_->cause != WiringCause::kStuck &&
                         verdict_->cause != WiringCause::kDynamics;
  if (most >= kEnough || (is_wiring && most > 0.0)) {
    const Hypothesis* best = nullptr;
    for (const Hypothesis& each : hypotheses_) {
      if (each.evidence < kSimilar * most) continue;
      if (best == nullptr || each.total > best->total) best = &each;
    }
    std::vector<int> elements;
    if (best->cause != WiringCause::kDelay) elements.push_back(static_cast<int>(best->i));
    if (best->cause == WiringCause::kExchanged) elements.push_back(static_cast<int>(best->j));
    return SetVerdict(best->cause, std::move(elements), best->total);
  }
  const bool is_dynamics =
      verdict_.has_value() && verdict_->cause == WiringCause::kDynamics && unusual_ > 0.0;
  if (verdict_.has_value() && verdict_->cause != WiringCause::kStuck && !is_dynamics) {
    verdict_.reset();
    return OpenWindow();
  }
  if (!verdict_.has_value() && unusual_ >= kUnusual) {
    SetVerdict(WiringCause::kDynamics, {}, unusual_);
  }
  std::erase_if(hypotheses_, [](const Hypothesis& each) { return each.total < kContradicted; });
  const bool has_evidence = most > 0.0 || unusual_ > 0.0;
  const bool is_undecided = window_steps_ < kWindow && !hypotheses_.empty();
  if (verdict_.has_value() || is_undecided || (has_evidence && window_steps_ < 2 * kWindow)) return;
  is_open_ = false;
  hypotheses_ = {};
  steps_until_window_ = kPause;
}

void WiringCheck::CountRuns(absl::Span<const float> observation) {
  for (size_t i = 0; i < runs_.size(); ++i) {
    if (observation[i] != before_[i]) {
      const bool was_stuck = verdict_.has_value() && verdict_->cause == WiringCause::kStuck &&
                             verdict_->elements[0] == static_cast<int>(i);
      if (was_stuck) verdict_.reset();
      runs_[i] = 0;
      continue;
    }
    ++runs_[i];
    if (verdict_.has_value() || runs_[i] < std::max(kStuckSteps, 2 * model_->longest_run[i])) {
      continue;
    }
    SetVerdict(WiringCause::kStuck, {static_cast<int>(i)}, 0.0);
  }
}

std::string WiringCheck::Named(size_t element) const {
  const std::string place = absl::StrCat("observation[", element, "]");
  const std::vector<Feature>& features = policy_.features.observation;
  return features.empty() ? place : absl::StrCat(place, " (", features[element].name, ")");
}

void WiringCheck::SetVerdict(WiringCause cause, std::vector<int> elements, double evidence) {
  const bool is_same =
      verdict_.has_value() && verdict_->cause == cause && verdict_->elements == elements;
  if (is_same) {
    verdict_->evidence = evidence;
    return;
  }
  const auto named = [&](size_t i) { return Named(static_cast<size_t>(elements[i])); };
  std::string text;
  switch (cause) {
    case WiringCause::kExchanged:
      text = absl::StrCat(named(0), " and ", named(1), " look exchanged");
      break;
    case WiringCause::kSign:
      text = absl::StrCat(named(0), " looks as if it had the other sign");
      break;
    case WiringCause::kUnit:
      text = absl::StrCat(named(0), " looks like degrees, expected radians");
      break;
    case WiringCause::kStuck:
      text = absl::StrCat(named(0), " has not changed for ",
                          runs_[static_cast<size_t>(elements[0])], " steps");
      break;
    case WiringCause::kDelay:
      text = "the observations look one step old";
      break;
    case WiringCause::kDynamics:
      text = "the observations change otherwise than in training, and no wiring explains it";
      break;
  }
  verdict_ = {.cause = cause,
              .elements = std::move(elements),
              .text = std::move(text),
              .evidence = evidence};
}

}  // namespace spikeserve
