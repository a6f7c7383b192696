#include "core/agent/wiring_step.h"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

constexpr double kImplausible = 4.0;  // deviations from the mean from which a unit is wrong
constexpr double kDegree = std::numbers::pi / 180.0;
constexpr double kLogOfDegree = 4.048223198220452;  // -ln(pi / 180)

// Returns the value that `wiring` gives its `element`, i or j, of the observation `from`.
double Rewired(const Wiring& wiring, size_t element, absl::Span<const float> from) {
  const auto value = [&](size_t other) { return static_cast<double>(from[other]); };
  if (wiring.cause == WiringCause::kSign) return -value(element);
  if (wiring.cause == WiringCause::kUnit) return value(element) * kDegree;
  return value(element == wiring.i ? wiring.j : wiring.i);
}

}  // namespace

size_t Wirings(size_t obs) { return obs * (obs - 1) / 2 + 2 * obs + 1; }

Wiring WiringOf(size_t number, size_t obs) {
  for (size_t i = 0; i + 1 < obs; ++i) {
    const size_t pairs = obs - 1 - i;
    if (number < pairs) return {WiringCause::kExchanged, i, i + 1 + number};
    number -= pairs;
  }
  if (number < obs) return {WiringCause::kSign, number};
  if (number < 2 * obs) return {WiringCause::kUnit, number - obs};
  return {WiringCause::kDelay};
}

struct WiringStep::Scratch {
  Action action;
  // [act], of the step's timestep and of the one before; empty: unknown.
  std::vector<float> actions[2];
  std::vector<double> terms;
  std::vector<double> before, after, change;  // [obs], in standard units, as trained
  std::vector<double> slopes;                 // [obs, obs], of `change`
  std::vector<double> other_before, other_after, other_change;  // of another wiring
};

WiringStep::Scratch& WiringStep::ThreadScratch() {
  thread_local Scratch scratch;
  return scratch;
}

WiringStep::WiringStep(const Policy& policy, const History& history, size_t t,
                       absl::Span<const float> after)
    : model_(*policy.wiring),
      before_(history.observation(t)),
      after_(after),
      scratch_(ThreadScratch()) {
  const size_t obs = model_.size();
  SPIKESERVE_DCHECK_EQ(after.size(), obs);
  for (size_t age = 0; age < 2; ++age) {
    std::vector<float>& encoded = scratch_.actions[age];
    encoded.clear();
    if (age > t) continue;
    history.action(t - age, &scratch_.action);
    encoded.resize(static_cast<size_t>(policy.action_space.size()));
    policy.action_space.Encode(scratch_.action, absl::MakeSpan(encoded));
  }
  scratch_.terms.resize(WiringModel::Terms(obs, scratch_.actions[0].size()));
  scratch_.before.resize(obs);
  scratch_.after.resize(obs);
  scratch_.change.resize(obs);
  for (size_t i = 0; i < obs; ++i) {
    scratch_.before[i] = model_.Standardise(static_cast<double>(before_[i]), i);
    scratch_.after[i] = model_.Standardise(static_cast<double>(after_[i]), i);
  }
  model_.Predict(scratch_.before, scratch_.actions[0], absl::MakeSpan(scratch_.terms),
                 absl::MakeSpan(scratch_.change));
  surprise_ = model_.Surprise(scratch_.before, scratch_.after, scratch_.change);
}

WiringStep::Fit WiringStep::ExplainAsTrained() const {
  scratch_.other_change.assign(model_.size(), 0.0);
  return {.surprise = surprise_,
          .spread = model_.Spread(scratch_.after),
          .standing = model_.Surprise(scratch_.before, scratch_.after, scratch_.other_change)};
}

bool WiringStep::IsPlausible(const Wiring& wiring) const {
  if (wiring.cause != WiringCause::kUnit) return true;
  return std::max(std::abs(scratch_.before[wiring.i]), std::abs(scratch_.after[wiring.i])) >
         kImplausible;
}

WiringStep::Fit WiringStep::Explain(const Wiring& wiring, const Fit& trained) {
  if (wiring.cause == WiringCause::kDelay) return ExplainDelay(trained);
  if (!has_slopes_) {
    scratch_.slopes.resize(model_.size() * model_.size());
    model_.FillSlopes(scratch_.before, scratch_.actions[0], absl::MakeSpan(scratch_.slopes));
    has_slopes_ = true;
  }
  const size_t elements[2] = {wiring.i, wiring.j};
  const size_t rewired = wiring.cause == WiringCause::kExchanged ? 2 : 1;
  WiringModel::Move moves[2];
  scratch_.other_before = scratch_.before;
  scratch_.other_after = scratch_.after;
  bool is_other = false;
  for (size_t k = 0; k < rewired; ++k) {
    const size_t i = elements[k];
    const double before = model_.Standardise(Rewired(wiring, i, before_), i);
    const double after = model_.Standardise(Rewired(wiring, i, after_), i);
    moves[k] = {.element = i, .by = before - scratch_.before[i]};
    is_other |= moves[k].by != 0.0 || after != scratch_.after[i];
    scratch_.other_before[i] = before;
    scratch_.other_after[i] = after;
  }
  if (!is_other) return trained;
  scratch_.other_change = scratch_.change;
  model_.AddMoves(scratch_.slopes, absl::MakeConstSpan(moves, rewired),
                  absl::MakeSpan(scratch_.other_change));
  const double constant = wiring.cause == WiringCause::kUnit ? kLogOfDegree : 0.0;
  return {.surprise = constant + model_.Surprise(scratch_.other_before, scratch_.other_after,
                                                 scratch_.other_change),
          .spread = model_.Spread(scratch_.other_after)};
}

// The observations are as trained, but belong to the action before.
WiringStep::Fit WiringStep::ExplainDelay(const Fit& trained) const {
  if (scratch_.actions[1].empty()) return trained;
  model_.Predict(scratch_.before, scratch_.actions[1], absl::MakeSpan(scratch_.terms),
                 absl::MakeSpan(scratch_.other_change));
  return {.surprise = model_.Surprise(scratch_.before, scratch_.after, scratch_.other_change),
          .spread = trained.spread};
}

}  // namespace spikeserve
