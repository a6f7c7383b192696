#include "core/agent/wiring_check.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <numbers>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/contract/dcheck.h"
#include "core/model/features.h"
#include "core/model/wiring_model.h"

namespace spikeserve {
namespace {

constexpr double kEnough = 25.0;         // evidence for a verdict
constexpr double kMost = 50.0;           // evidence that is kept, so that it can be withdrawn
constexpr double kStep = 8.0;            // most evidence of one step
constexpr double kUsualStep = 1.5;       // most evidence of a step that is not unusual
constexpr double kNearer = 3.0;          // weight of a distance against a robot that stands still
constexpr double kContradicted = -30.0;  // total at which a hypothesis is given up
constexpr double kSimilar = 0.5;         // share of the best evidence that may name the cause
constexpr double kUnusualStep = 4.0;     // most evidence of one step against all wirings
constexpr double kUnusual = 120.0;       // that evidence for a verdict
constexpr int64_t kWindow = 50;          // steps of a window
constexpr int64_t kPeriod = 1000;        // steps from one window of an episode to the next
constexpr int64_t kStuckSteps = 50;
constexpr double kImplausible = 4.0;  // deviations from the mean from which a unit is wrong
constexpr double kDegree = std::numbers::pi / 180.0;
constexpr double kLogOfDegree = 4.048223198220452;  // -ln(pi / 180)

// A wiring other than that of the training data.
struct Wiring {
  WiringCause cause = WiringCause::kDelay;
  size_t i = 0, j = 0;  // elements
};

// Returns how many wirings there are of `obs` elements: the pairs, the signs, the units, the delay.
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

bool MayBeAngle(const Features& features, size_t element) {
  if (element >= features.observation.size()) return true;
  const std::string& unit = features.observation[element].unit;
  return unit.empty() || unit.starts_with("rad");
}

// Returns after how many steps without a change an element counts as stuck.
int64_t StuckSteps(const WiringModel& model, size_t element) {
  return std::max(kStuckSteps, 2 * model.longest_run[element]);
}

bool IsWiring(const std::optional<WiringVerdict>& verdict) {
  return verdict.has_value() && verdict->cause != WiringCause::kStuck &&
         verdict->cause != WiringCause::kDynamics;
}

void OpenWindow(const Policy& policy, WiringState* state) {
  const size_t obs = policy.wiring->size();
  state->is_open = true;
  state->steps = 0;
  state->unusual = 0.0;
  state->hypotheses.clear();
  for (size_t number = 0; number < Wirings(obs); ++number) {
    const Wiring wiring = WiringOf(number, obs);
    if (wiring.cause == WiringCause::kUnit && !MayBeAngle(policy.features, wiring.i)) continue;
    state->hypotheses.push_back({.number = static_cast<uint16_t>(number)});
  }
}

void CloseWindow(WiringState* state) {
  state->is_open = false;
  state->steps = 0;
  state->unusual = 0.0;
  state->hypotheses = {};
}

// The memory of a thread, which its checks reuse.
struct Scratch {
  Action action;
  std::vector<float>
      actions[2];  // [act], of the last timestep and of the one before; empty: unknown
  std::vector<double> numbers;
};

// The step from the last timestep of a history to an observation.
class WiringStep {
 public:
  WiringStep(const Policy& policy, const History& history, absl::Span<const float> observation)
      : model_(*policy.wiring),
        before_(history.observation(history.size() - 1)),
        after_(observation),
        scratch_(ThreadScratch()) {
    for (size_t age = 0; age < 2; ++age) {
      std::vector<float>& encoded = scratch_.actions[age];
      encoded.clear();
      if (age >= history.size()) continue;
      history.action(history.size() - 1 - age, &scratch_.action);
      encoded.resize(static_cast<size_t>(policy.action_space.size()));
      policy.action_space.Encode(scratch_.action, absl::MakeSpan(encoded));
    }
  }

  bool knows_action_before() const { return !scratch_.actions[1].empty(); }

  struct Fit {
    double surprise;  // of the step
    double distance;  // of its observation
    double standing;  // surprise of the step if the robot stood still
  };
  // Returns how a wiring (null: the training data's) explains the step.
  Fit Explain(const Wiring* wiring) const;

  // A unit is plausible only if the element is far from the training data without it.
  bool IsPlausible(const Wiring& wiring) const {
    if (wiring.cause != WiringCause::kUnit) return true;
    const auto distance = [&](float value) {
      return std::abs(static_cast<double>(value) - model_.mean[wiring.i]) /
             model_.deviation[wiring.i];
    };
    return std::max(distance(before_[wiring.i]), distance(after_[wiring.i])) > kImplausible;
  }

 private:
  static Scratch& ThreadScratch() {
    thread_local Scratch scratch;
    return scratch;
  }

  const WiringModel& model_;
  const absl::Span<const float> before_, after_;
  Scratch& scratch_;
};

WiringStep::Fit WiringStep::Explain(const Wiring* wiring) const {
  const size_t obs = model_.size();
  const bool is_delayed = wiring != nullptr && wiring->cause == WiringCause::kDelay;
  const std::vector<float>& action = scratch_.actions[is_delayed ? 1 : 0];
  const size_t terms = WiringModel::Terms(obs, action.size());
  scratch_.numbers.resize(terms + 3 * obs);
  const auto all = absl::MakeSpan(scratch_.numbers);
  const auto z_before = all.subspan(0, obs);
  const auto z_after = all.subspan(obs, obs);
  double constant = 0.0;
  const auto standardise = [&](absl::Span<const float> from, absl::Span<double> z) {
    std::copy(from.begin(), from.end(), z.begin());
    if (wiring != nullptr) {
      if (wiring->cause == WiringCause::kExchanged) std::swap(z[wiring->i], z[wiring->j]);
      if (wiring->cause == WiringCause::kSign) z[wiring->i] = -z[wiring->i];
      if (wiring->cause == WiringCause::kUnit) z[wiring->i] *= kDegree;
    }
    for (size_t i = 0; i < obs; ++i) z[i] = (z[i] - model_.mean[i]) / model_.deviation[i];
  };
  standardise(before_, z_before);
  standardise(after_, z_after);
  if (wiring != nullptr && wiring->cause == WiringCause::kUnit) constant = kLogOfDegree;
  const auto change = all.subspan(2 * obs, obs);
  Fit fit = {.surprise = constant, .distance = model_.Distance(z_after), .standing = 0.0};
  if (wiring == nullptr) {
    std::fill(change.begin(), change.end(), 0.0);
    fit.standing = model_.Surprise(z_before, z_after, change);
  }
  model_.Predict(z_before, action, all.subspan(3 * obs, terms), change);
  fit.surprise += model_.Surprise(z_before, z_after, change);
  return fit;
}

// Compares all hypotheses for a step.
void Compare(const WiringModel& model, const WiringStep& step, WiringState* state) {
  const WiringStep::Fit trained = step.Explain(nullptr);
  const double excess = trained.surprise - model.usual_surprise;
  double least = trained.surprise;
  for (WiringHypothesis& each : state->hypotheses) {
    const Wiring wiring = WiringOf(each.number, model.size());
    if (wiring.cause == WiringCause::kDelay && !step.knows_action_before()) continue;
    const WiringStep::Fit fit = step.Explain(&wiring);
    least = std::min(least, fit.surprise);
    const double farther = std::max(0.0, fit.distance - trained.distance);
    double gain = trained.surprise - fit.surprise;
    if (gain > 0.0 && !step.IsPlausible(wiring)) gain = 0.0;
    if (gain > 0.0) {
      const double nearer = std::max(0.0, trained.distance - fit.distance);
      gain = std::clamp(trained.standing - fit.surprise + kNearer * nearer, 0.0, gain);
    }
    each.total = static_cast<float>(static_cast<double>(each.total) + gain - farther);
    if (gain > 0.0) {
      const double misfit = std::max(0.0, fit.surprise - model.usual_surprise);
      gain = std::max(0.0, std::min(gain - misfit - farther, std::max(excess, kUsualStep)));
    }
    const double evidence = static_cast<double>(each.evidence) + std::clamp(gain, -kStep, kStep);
    each.evidence = static_cast<float>(std::clamp(evidence, 0.0, kMost));
  }
  state->unusual += std::clamp(least - model.usual_surprise, -kUnusualStep, kUnusualStep);
  state->unusual = std::clamp(state->unusual, 0.0, 2.0 * kUnusual);
  ++state->steps;
}

// Returns the verdict of the hypothesis that explains the steps best of those with about the most
// evidence.
WiringVerdict BestWiring(const std::vector<WiringHypothesis>& hypotheses, double most, size_t obs) {
  const WiringHypothesis* best = nullptr;
  for (const WiringHypothesis& each : hypotheses) {
    if (static_cast<double>(each.evidence) < kSimilar * most) continue;
    if (best == nullptr || each.total > best->total) best = &each;
  }
  const Wiring wiring = WiringOf(best->number, obs);
  WiringVerdict verdict = {
      .cause = wiring.cause, .elements = {}, .evidence = static_cast<double>(best->total)};
  if (wiring.cause != WiringCause::kDelay) verdict.elements.push_back(static_cast<int>(wiring.i));
  if (wiring.cause == WiringCause::kExchanged) {
    verdict.elements.push_back(static_cast<int>(wiring.j));
  }
  return verdict;
}

// Begins, changes or withdraws the verdict, and closes the window when it has shown enough.
void Judge(const Policy& policy, WiringState* state) {
  double most = 0.0;
  for (const WiringHypothesis& each : state->hypotheses) {
    most = std::max(most, static_cast<double>(each.evidence));
  }
  std::optional<WiringVerdict>& verdict = state->verdict;
  if (most >= kEnough || (IsWiring(verdict) && most > 0.0)) {
    verdict = BestWiring(state->hypotheses, most, policy.wiring->size());
    return;
  }
  const bool is_dynamics =
      verdict.has_value() && verdict->cause == WiringCause::kDynamics && state->unusual > 0.0;
  if (verdict.has_value() && verdict->cause != WiringCause::kStuck && !is_dynamics) {
    verdict.reset();
    return OpenWindow(policy, state);
  }
  if (!verdict.has_value() && state->unusual >= kUnusual) {
    verdict = {.cause = WiringCause::kDynamics, .elements = {}, .evidence = state->unusual};
  }
  std::erase_if(state->hypotheses, [](const WiringHypothesis& each) {
    return static_cast<double>(each.total) < kContradicted;
  });
  const bool has_evidence = most > 0.0 || state->unusual > 0.0;
  const bool is_undecided = state->steps < kWindow && !state->hypotheses.empty();
  const bool goes_on = is_undecided || (has_evidence && state->steps < 2 * kWindow);
  if (!verdict.has_value() && !goes_on) CloseWindow(state);
}

// Counts the steps in which an element has not changed.
void CountRuns(const WiringModel& model, absl::Span<const float> before,
               absl::Span<const float> after, WiringState* state) {
  std::vector<int64_t>& runs = state->runs;
  bool runs_on = false;
  for (size_t i = 0; i < after.size(); ++i) {
    const bool stands = after[i] == before[i];
    if (stands && runs.empty()) runs.resize(after.size());
    if (!runs.empty()) runs[i] = stands ? runs[i] + 1 : 0;
    runs_on |= stands;
    std::optional<WiringVerdict>& verdict = state->verdict;
    if (stands && !verdict.has_value() && runs[i] >= StuckSteps(model, i)) {
      verdict = {.cause = WiringCause::kStuck, .elements = {static_cast<int>(i)}};
    } else if (!stands && verdict.has_value() && verdict->cause == WiringCause::kStuck &&
               verdict->elements[0] == static_cast<int>(i)) {
      verdict.reset();
    }
  }
  if (!runs_on) runs.clear();
}

}  // namespace

bool CheckWiring(const Policy& policy, int64_t step, const History& history,
                 absl::Span<const float> observation, WiringState* state) {
  const WiringModel& model = *policy.wiring;
  SPIKESERVE_DCHECK_EQ(observation.size(), model.size());
  const bool had_verdict = state->verdict.has_value();
  if (history.empty()) state->runs.clear();
  if (step % kPeriod == 0 && !state->is_open) OpenWindow(policy, state);
  if (history.empty()) return false;
  CountRuns(model, history.observation(history.size() - 1), observation, state);
  if (state->is_open) {
    Compare(model, WiringStep(policy, history, observation), state);
    Judge(policy, state);
  }
  return state->verdict.has_value() && !had_verdict;
}

std::string WiringText(const Policy& policy, const WiringVerdict& verdict) {
  const auto named = [&](size_t i) {
    const auto element = static_cast<size_t>(verdict.elements[i]);
    const std::string place = absl::StrCat("observation[", element, "]");
    const std::vector<Feature>& features = policy.features.observation;
    return features.empty() ? place : absl::StrCat(place, " (", features[element].name, ")");
  };
  switch (verdict.cause) {
    case WiringCause::kExchanged:
      return absl::StrCat(named(0), " and ", named(1), " look exchanged");
    case WiringCause::kSign:
      return absl::StrCat(named(0), " looks as if it had the other sign");
    case WiringCause::kUnit:
      return absl::StrCat(named(0), " looks like degrees, expected radians");
    case WiringCause::kStuck:
      return absl::StrCat(named(0), " has not changed for ",
                          StuckSteps(*policy.wiring, static_cast<size_t>(verdict.elements[0])),
                          " steps");
    case WiringCause::kDelay:
      return "the observations look one step old";
    case WiringCause::kDynamics:
      return "the observations change otherwise than in training, and no wiring explains it";
  }
  return "";
}

absl::Status CheckWiringState(const Policy& policy, const WiringState& state) {
  if (state == WiringState()) return absl::OkStatus();
  const auto refused = [](absl::string_view what) {
    return absl::InvalidArgumentError(absl::StrCat("session.wiring: expected ", what));
  };
  if (policy.wiring == nullptr) return refused("none, because the policy has no model of it");
  const size_t obs = policy.wiring->size();
  if (!state.runs.empty() && state.runs.size() != obs) return refused("a run for each element");
  size_t least = 0;
  for (const WiringHypothesis& each : state.hypotheses) {
    if (each.number < least || each.number >= Wirings(obs)) return refused("ascending numbers");
    least = each.number + size_t{1};
  }
  if (!state.verdict.has_value()) return absl::OkStatus();
  const WiringCause cause = state.verdict->cause;
  const bool has_none = cause == WiringCause::kDelay || cause == WiringCause::kDynamics;
  const size_t elements = cause == WiringCause::kExchanged ? 2 : has_none ? 0 : 1;
  if (state.verdict->elements.size() != elements) return refused("the elements of the verdict");
  for (const int element : state.verdict->elements) {
    if (element < 0 || static_cast<size_t>(element) >= obs) return refused("elements that exist");
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
