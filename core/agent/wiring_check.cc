#include "core/agent/wiring_check.h"

#include <algorithm>
#include <memory>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/agent/wiring_step.h"
#include "core/contract/dcheck.h"
#include "core/math/portable.h"
#include "core/model/features.h"
#include "core/model/wiring_model.h"

namespace spikeserve {
namespace {

// Without a window, only the wiring of the training data is computed.
constexpr int64_t kPeriod = 1000;
constexpr int64_t kWatched = 50;        // first steps of each period in which a window may open
constexpr int64_t kEvery = 3;           // of these, steps from one that is computed to the next
constexpr double kReference = 0.67;     // of the usual surprise: above it, a step is suspicious
constexpr double kMostReference = 8.5;  // and at most this
constexpr double kMostExcess = 10.0;    // most surprise above that of one step
constexpr double kSuspicious = 8.0;     // sum of these that opens a window
constexpr size_t kReplayed = 5;         // steps before, with which the window begins

// A window computes every wiring.
constexpr double kEnough = 25.0;         // evidence for a verdict
constexpr double kMost = 50.0;           // evidence that is kept, so that it can be withdrawn
constexpr double kStep = 8.0;            // most evidence of one step
constexpr double kUsualStep = 2.0;       // most evidence of a step that is not unusual
constexpr double kNearer = 3.0;          // weight of a distance against a robot that stands still
constexpr double kContradicted = -15.0;  // total at which a hypothesis is given up
constexpr double kSimilar = 0.5;         // share of the best evidence that may name the cause
constexpr double kUnusualStep = 4.0;     // most evidence of one step against all wirings
constexpr double kUnusual = 140.0;       // that evidence for a verdict
constexpr int64_t kWindow = 100;         // steps in which a window may have evidence and no verdict
constexpr int64_t kStuckSteps = 50;

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

// `steps` of the window have passed.
void OpenWindow(const Policy& policy, int64_t steps, WiringState* state) {
  const size_t obs = policy.wiring->size();
  state->is_open = true;
  state->steps = steps;
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

// Returns ln(a / b), but at least 0.
double Excess(double a, double b) { return a > b ? portable::Log(a / b) : 0.0; }

// Compares all hypotheses for a step, and gives up those that it contradicts.
void Compare(const Policy& policy, WiringStep step, WiringState* state) {
  const WiringModel& model = *policy.wiring;
  const WiringStep::Fit trained = step.ExplainAsTrained();
  const double excess = trained.surprise - model.usual_surprise;
  double least = trained.surprise;
  for (WiringHypothesis& each : state->hypotheses) {
    const Wiring wiring = WiringOf(each.number, model.size());
    const WiringStep::Fit fit = step.Explain(wiring, trained);
    least = std::min(least, fit.surprise);
    const double farther = Excess(fit.spread, trained.spread);
    double gain = trained.surprise - fit.surprise;
    if (gain > 0.0 && !step.IsPlausible(wiring)) gain = 0.0;
    if (gain > 0.0) {
      const double nearer = Excess(trained.spread, fit.spread);
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
  if (IsWiring(state->verdict)) return;  // so that another cause may follow
  std::erase_if(state->hypotheses, [](const WiringHypothesis& each) {
    return static_cast<double>(each.total) < kContradicted;
  });
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
    return OpenWindow(policy, /*steps=*/0, state);
  }
  if (!verdict.has_value() && state->unusual >= kUnusual) {
    verdict = {.cause = WiringCause::kDynamics, .elements = {}, .evidence = state->unusual};
  }
  const bool goes_on = (most > 0.0 || state->unusual > 0.0) && state->steps < kWindow;
  if (!verdict.has_value() && !goes_on) CloseWindow(state);
}

// Opens a window, and compares the steps before the last one, if these surprise the wiring of the
// training data.
void Watch(const Policy& policy, int64_t step, const History& history,
           absl::Span<const float> observation, WiringState* state) {
  if (step % kPeriod > kWatched) state->unusual = 0.0;
  if (step % kPeriod > kWatched || (state->unusual == 0.0 && step % kEvery != 0)) return;
  const size_t last = history.size() - 1;
  const double surprise = WiringStep(policy, history, last, observation).surprise();
  const double reference = std::min(kReference * policy.wiring->usual_surprise, kMostReference);
  state->unusual += std::min(surprise - reference, kMostExcess);
  state->unusual = std::max(state->unusual, 0.0);
  if (state->unusual < kSuspicious) return;
  const size_t first = last - std::min(last, kReplayed);
  const auto replayed = static_cast<int64_t>(last - first) + 1;
  OpenWindow(policy, std::max(step % kPeriod - replayed, int64_t{0}), state);
  for (size_t t = first; t < last; ++t) {
    Compare(policy, WiringStep(policy, history, t, history.observation(t + 1)), state);
  }
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
    const bool is_unexplained = !verdict.has_value() || verdict->cause == WiringCause::kDynamics;
    if (stands && is_unexplained && runs[i] >= StuckSteps(model, i)) {
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
  if (history.empty()) {
    state->runs.clear();
    return false;
  }
  const size_t last = history.size() - 1;
  CountRuns(model, history.observation(last), observation, state);
  if (!state->is_open) Watch(policy, step, history, observation, state);
  if (state->is_open) {
    Compare(policy, WiringStep(policy, history, last, observation), state);
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
