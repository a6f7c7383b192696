#include <algorithm>
#include <cmath>
#include <functional>
#include <memory>
#include <utility>
#include <vector>

#include "absl/base/attributes.h"
#include "absl/strings/str_cat.h"
#include "core/action/action_space.h"
#include "core/agent/repeated_step.h"
#include "core/agent/session_passes.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/session/session_value.h"

namespace spikeserve {
namespace {

// Sorts `all` by policy version, and calls `visit` once per version with the elements of that
// version.
template <typename T, typename VersionOf, typename Visit>
void ForEachVersion(std::vector<T*>& all, VersionOf version_of, Visit visit) {
  const auto is_before = [version_of](T* a, T* b) {
    return std::less<>()(version_of(a), version_of(b));
  };
  if (!std::is_sorted(all.begin(), all.end(), is_before)) {
    std::sort(all.begin(), all.end(), is_before);
  }
  for (size_t first = 0, last = 0; first < all.size(); first = last) {
    while (last < all.size() && version_of(all[last]) == version_of(all[first])) ++last;
    visit(absl::MakeConstSpan(all).subspan(first, last - first));
  }
}

bool AllFinite(absl::Span<const float> values) {
  return std::all_of(values.begin(), values.end(),
                     [](float value) { return std::isfinite(value); });
}

bool IsFinite(const Answer& answer) {
  return AllFinite(answer.logits) && AllFinite(answer.probabilities) &&
         AllFinite(answer.action.continuous) && std::isfinite(answer.return_to_go);
}

// Returns the reward that a request for the next step counts: 0 at step 0, where no action was
// taken before.
double CountedReward(const Session& session, double reward) {
  return session.step == 0 ? 0.0 : reward;
}

// Returns the input of the token of `action`, which lies in `memory`.
absl::Span<const float> Encode(const ActionSpace& space, const Action& action,
                               std::vector<float>* memory) {
  memory->resize(static_cast<size_t>(space.size()));
  space.Encode(action, absl::MakeSpan(*memory));
  return *memory;
}

// Returns a context that holds the history of `session`: the same calls with the same numbers leave
// the same keys and values in it.
std::unique_ptr<Engine::Context> ContextOf(const ServedPolicy& served, const Session& session) {
  const Engine& engine = *served.engine;
  const History& history = session.history;
  auto context = engine.NewContext(session.step - static_cast<int64_t>(history.size()));
  Engine::Output ignored;
  std::vector<float> encoded;
  for (size_t i = 0; i < history.size(); ++i) {
    engine.Decide(*context, history.return_to_go(i), history.observation(i), &ignored);
    engine.AppendAction(*context,
                        Encode(served.policy().action_space, history.action(i), &encoded));
  }
  return context;
}

// Memory of a thread, which its decisions reuse, so that a warm decision allocates none.
struct DecisionScratch {
  std::vector<AgentSession*> sessions;
  std::vector<Engine::Decision> decisions;
  std::vector<Engine::Output> outputs;
  ActionChoice choice;
};

// Not inlined, because in a shared library the compiler would call a function for the address again
// at every access.
ABSL_ATTRIBUTE_NOINLINE DecisionScratch& ThreadScratch() {
  thread_local DecisionScratch scratch;
  return scratch;
}

}  // namespace

absl::Status AgentSession::CheckNewDecision(Step& step) const {
  const ActionSpace& space = served_->policy().action_space;
  if (step.place.step.has_value() && *step.place.step != session_.step) {
    return absl::FailedPreconditionError(
        absl::StrCat("step: expected ", session_.step, ", received ", *step.place.step));
  }
  const bool is_checked = step.result.checked;  // with the history
  if (!is_checked) {
    RETURN_IF_ERROR(CheckObservation(step.observation, served_->policy().observation_size()));
  }
  step.result.executed.reset();
  if (session_.step == 0) return absl::OkStatus();
  if (step.executed.has_value() && before_skipped_ == nullptr) {
    ASSIGN_OR_RETURN(step.result.executed, ParseExecutedAction(*step.executed, space));
  }
  return is_checked ? absl::OkStatus()
                    : CheckReward(step.reward, NextReturnToGo(session_, step.reward));
}

void AgentSession::TakeExecuted(const Action& executed, const ReportedSource& source) {
  SPIKESERVE_DCHECK(!session_.history.empty());
  SPIKESERVE_DCHECK(policy().action_space.Contains(executed).ok());
  const bool is_known = executed == session_.history.action(session_.history.size() - 1);
  if (source.kind != 0 || !is_known) {
    session_.executed_source = {.kind = static_cast<SourceKind>(source.kind),
                                .operator_id = std::string(source.operator_id)};
  }
  if (session_.executed_source.kind == SourceKind::kOperator) {
    head_.OnOperator(executed, session_.executed_source.operator_id, &session_);
  }
  if (is_known) return;
  context_.OnExecuted();
  head_.OnExecuted(executed, &session_);
  for (const auto& listener : listeners_) listener->OnExecuted(executed);
}

absl::Status AgentSession::NonFiniteError() const {
  served_->observer->OnNonFinite();
  for (const auto& listener : listeners_) listener->OnFailure();
  return absl::InternalError(
      absl::StrCat("decision: expected finite numbers, received NaN or infinity from policy ",
                   served_->name, " version ", served_->version, "; the session has not changed"));
}

bool AgentSession::DecisionPass::IsNew(Step& step) {
  AgentSession& agent = *step.session;
  const Session& session = agent.session_;
  const Place& place = step.place;
  StepOutcome& result = step.result;
  const bool names_last = !place.decision.has_value() || *place.decision + 1 == session.decisions;
  result.is_retry =
      session.last_answer.has_value() && place.step == session.last_answer->step && names_last;
  if (!result.is_retry) {
    result.status = agent.CheckNewDecision(step);
    if (place.decision.has_value() && *place.decision != session.decisions) {
      result.status = absl::FailedPreconditionError(
          absl::StrCat("decision: expected ", session.decisions, ", received ", *place.decision));
    }
    if (!result.status.ok()) agent.RestoreSkipped();
    return result.status.ok();
  }
  result.status = CheckRepeatedStep(step);
  // A store may hold an answer of a server that did not check it.
  if (result.status.ok() && !IsFinite(*session.last_answer)) result.status = agent.NonFiniteError();
  if (!result.status.ok()) return false;
  result.answer = &*session.last_answer;
  agent.served_->observer->OnRepeated();
  return false;
}

void AgentSession::DecisionPass::Decide(std::vector<Step*>& steps) {
  ForEachVersion(
      steps, [](const Step* step) { return step->session->served_.get(); },
      [](absl::Span<Step* const> part) { DecideVersion(part); });
}

void AgentSession::DecisionPass::DecideVersion(absl::Span<Step* const> steps) {
  auto& [sessions, decisions, outputs, choice] = ThreadScratch();
  const ServedPolicy& served = *steps[0]->session->served_;
  const Clock& clock = *steps[0]->session->clock_;
  absl::Duration last = clock.Now();
  sessions.clear();
  for (const Step* step : steps) {
    AgentSession& session = *step->session;
    session.head_.TakeMerged(&session.session_);
    if (session.session_.step == 0) session.LearnOverdue();
    sessions.push_back(&session);
    ConfirmNeutral(*step, step->result.executed);
    if (step->result.executed.has_value()) {
      session.TakeExecuted(*step->result.executed, step->executed->source);
    }
    auto& context = session.context_.engine;
    if (context == nullptr) context = ContextOf(served, session.session_);
  }
  AppendActions(sessions);
  decisions.clear();
  if (outputs.size() < steps.size()) outputs.resize(steps.size());
  for (size_t i = 0; i < steps.size(); ++i) {
    AgentSession& session = *steps[i]->session;
    const double return_to_go = NextReturnToGo(session.session_, steps[i]->reward);
    session.context_.lacks_action = true;
    decisions.push_back({session.context_.engine.get(), static_cast<float>(return_to_go),
                         steps[i]->observation, &outputs[i]});
  }
  served.engine->DecideTogether(decisions);
  const absl::Duration decided = clock.Now();
  const absl::Duration share = (decided - last) / static_cast<int64_t>(steps.size());
  last = decided;
  for (size_t i = 0; i < steps.size(); ++i) {
    Step& step = *steps[i];
    AgentSession& session = *step.session;
    session.head_.Choose(session.session_, outputs[i].readout, &choice);
    // Probabilities and actions are finite where the logits are.
    if (!AllFinite(choice.logits)) {
      session.context_.Drop();  // it holds the decision that was not made
      session.RestoreSkipped();
      step.result.status = session.NonFiniteError();
      continue;
    }
    CheckWiring(session, step.observation);
    Answer answer = MakeAnswer(session, outputs[i], step.reward, &choice);
    answer.unusual_observations =
        served.observer->CountUnusual(step.observation, static_cast<double>(answer.return_to_go));
    const absl::Duration chosen = clock.Now();
    answer.compute_seconds = absl::ToDoubleSeconds(share + (chosen - last));
    last = chosen;
    Record(step, std::move(answer), outputs[i].readout, choice.noise);
    const Answer& answered = *session.session_.last_answer;
    session.life_.OnDecision(chosen - session.created_, answered.counts.total_spikes(),
                             answered.compute_seconds);
    session.life_.OnCounts(answered.counts);
    session.life_.help().OnDecision(answered);
    step.result.answer = &answered;
    step.is_past ? served.observer->OnBeat(answered) : served.observer->OnDecision(answered);
  }
}

void AgentSession::DecisionPass::CheckWiring(AgentSession& agent,
                                             absl::Span<const float> observation) {
  Session& session = agent.session_;
  if (agent.policy().wiring == nullptr) return;
  if (!spikeserve::CheckWiring(agent.policy(), session.step, session.history, observation,
                               &session.wiring)) {
    return;
  }
  const WiringVerdict& verdict = *session.wiring.verdict;
  agent.served_->observer->OnWiring(session.id, verdict.cause, WiringText(agent.policy(), verdict),
                                    agent.wiring_response_);
}

// Reuses the memory of the session's last answer.
Answer AgentSession::DecisionPass::MakeAnswer(AgentSession& agent, const Engine::Output& output,
                                              double reward, ActionChoice* choice) {
  Session& session = agent.session_;
  const double counted = CountedReward(session, reward);
  Answer answer = session.last_answer.has_value() ? *std::move(session.last_answer) : Answer();
  answer.step = session.step;
  answer.return_to_go = static_cast<float>(NextReturnToGo(session, counted));
  answer.counts = output.counts;
  answer.source = {};
  answer.hold.reset();
  if (agent.hold_ != nullptr && session.learner.has_value()) session.learner->suspended = true;
  agent.head_.OnDecision(*choice, output.readout, static_cast<double>(answer.return_to_go), counted,
                         &session);
  std::swap(answer.action, choice->action);
  std::swap(answer.logits, choice->logits);
  std::swap(answer.probabilities, choice->probabilities);
  return answer;
}

void AgentSession::DecisionPass::Record(Step& step, Answer answer, absl::Span<const float> readout,
                                        absl::Span<const float> noise) {
  AgentSession& agent = *step.session;
  const bool lacks_reward = agent.session_.step > 0 && !step.has_reward;
  DecisionInputs inputs = {.reward = CountedReward(agent.session_, step.reward),
                           .executed = std::move(step.result.executed),
                           .source = std::move(agent.session_.executed_source),
                           .readout = readout,
                           .noise = noise,
                           .is_beat = step.is_past,
                           .after_gap = std::exchange(agent.before_skipped_, nullptr) != nullptr};
  const auto& learning = agent.session_.options.learning;
  const bool is_corrected = learning.has_value() && learning->rule == Rule::kCorrections &&
                            inputs.source.kind == SourceKind::kOperator;
  agent.blind_rewards_.clear();
  CountDecision(agent.policy(), std::move(answer), step.observation, inputs.reward,
                &agent.session_);
  inputs.needs_snapshot = Overrule(agent, step.is_past) || inputs.after_gap || is_corrected;
  if (agent.session_.step > 1 && !inputs.after_gap) agent.CountSource(inputs.source);
  for (const auto& listener : agent.listeners_) listener->OnDecision(agent.session_, inputs);
  if (lacks_reward) agent.CountMissingRewards(1);
}

void AgentSession::CountSource(const StepSource& source) {
  life_.OnSource(source);
  served_->observer->OnExecuted(source.kind);
}

bool AgentSession::DecisionPass::Overrule(AgentSession& agent, bool is_past) {
  Session& session = agent.session_;
  Answer& answer = *session.last_answer;
  const ActionSpace& space = agent.policy().action_space;
  bool is_over = false;  // the lease of an operator
  const Seat* const seat =
      session.seat.has_value() ? agent.seat_.Heard(&session, &is_over) : nullptr;
  if (is_over) agent.served_->observer->OnSeat(SeatChange::kEnded);
  Action action;
  if (agent.hold_ != nullptr) {
    action = NeutralAction(space);
    answer.source.kind = SourceKind::kHold;
    answer.hold = *agent.hold_;
  } else if (seat != nullptr && !is_past) {
    agent.seat_.CountStep(space, answer.action, &session);
    action = seat->action;
    answer.source = {SourceKind::kOperator, seat->operator_id};
    agent.head_.OnOperator(action, seat->operator_id, &session);
  } else if (agent.wiring_response_ == WiringResponse::kSafe &&
             session.wiring.verdict.has_value()) {
    action = NeutralAction(space);
    answer.source.kind = SourceKind::kSafetyLayer;
  } else {
    return is_over;
  }
  session.executed_source = answer.source;
  if (action != answer.action) {
    agent.head_.OnExecuted(action, &session);
    answer.action = std::move(action);
  }
  return is_over || seat != nullptr || session.learner.has_value();
}

void AgentSession::DecisionPass::ConfirmNeutral(const Step& step,
                                                const std::optional<Action>& executed) {
  AgentSession& agent = *step.session;
  const auto& last = agent.session_.last_answer;
  if (agent.hold_ == nullptr || !last.has_value() || last->hold != *agent.hold_) return;
  const bool is_safe = step.executed.has_value() &&
                       step.executed->source.kind == static_cast<int>(SourceKind::kSafe);
  agent.is_at_neutral_ = !executed.has_value() || *executed == last->action || is_safe;
}

void AgentSession::DecisionPass::AppendActions(absl::Span<AgentSession* const> sessions) {
  thread_local std::vector<AgentSession*> pending;
  pending.clear();
  for (AgentSession* session : sessions) {
    if (std::exchange(session->context_.lacks_action, false)) pending.push_back(session);
  }
  const auto append = [](absl::Span<AgentSession* const> part) {
    thread_local std::vector<std::vector<float>> encoded;
    thread_local std::vector<Engine::TakenAction> taken;
    thread_local Action action;  // reused, so that a warm decision allocates nothing
    taken.clear();
    if (encoded.size() < part.size()) encoded.resize(part.size());
    const ServedPolicy& served = *part[0]->served_;
    for (size_t i = 0; i < part.size(); ++i) {
      const History& history = part[i]->session_.history;
      history.action(history.size() - 1, &action);
      taken.push_back({part[i]->context_.engine.get(),
                       Encode(served.policy().action_space, action, &encoded[i])});
    }
    served.engine->AppendActionsTogether(taken);
  };
  ForEachVersion(
      pending, [](const AgentSession* session) { return session->served_.get(); }, append);
}

}  // namespace spikeserve
