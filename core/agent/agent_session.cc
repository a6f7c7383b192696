#include "core/agent/agent_session.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <map>
#include <memory>
#include <utility>
#include <vector>

#include "absl/base/attributes.h"
#include "absl/strings/str_cat.h"
#include "core/action/action_head.h"
#include "core/action/neutral_action.h"
#include "core/agent/repeated_step.h"
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

// Returns what follows from a verdict about the wiring of a session with these labels.
WiringResponse WiringResponseOf(const std::map<std::string, std::string>& labels,
                                const SessionObserver& observer) {
  const auto label = labels.find(kWiringLabel);
  if (label == labels.end()) return observer.wiring_response();
  return ParseEnum<WiringResponse>(kWiringLabel, label->second)
      .value_or(observer.wiring_response());
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

AgentSession::AgentSession(std::shared_ptr<const ServedPolicy> served, Session session,
                           const Clock* clock)
    : served_(std::move(served)),
      clock_(clock),
      session_(std::move(session)),
      created_(clock->Now()),
      life_(session_.decisions, session_.episode),
      head_(served_, &session_),
      wiring_response_(WiringResponseOf(session_.options.labels, *served_->observer)) {}

void AgentSession::AddListener(std::shared_ptr<SessionListener> listener) {
  SPIKESERVE_DCHECK(listener != nullptr);
  listeners_.push_back(std::move(listener));
}

// What one call of ActTogether does for sessions of one policy version, and EndEpisode for one.
struct AgentSession::Together {
  // Returns whether `call` requires a new decision. Otherwise sets its answer.
  static bool IsNewDecision(ActCall& call);
  static void Decide(absl::Span<ActCall* const> calls);
  // As AppendPendingActions, but also for agents that report executed actions.
  static void AppendActions(absl::Span<AgentSession* const> sessions);
  // Returns the answer that `choice` gives, without what only the session or the caller knows.
  // Leaves in `choice` what the answer does not store.
  static Answer MakeAnswer(AgentSession& session, const Engine::Output& output, double reward,
                           ActionChoice* choice);
  // Compares the observation of the next step with the wiring of the training data.
  static void CheckWiring(AgentSession& agent, absl::Span<const float> observation);
  // Adds the answer to the session, and reports it.
  static void Record(ActCall& call, Answer answer, absl::Span<const float> readout,
                     absl::Span<const float> noise);
  // Ends an episode that has a decision.
  static absl::StatusOr<EpisodeSummary> End(const EpisodeEnd& end, AgentSession& agent);
  // Undoes SkipSteps, if no decision has followed.
  static void RestoreSkipped(AgentSession& agent) {
    const auto before = std::exchange(agent.before_skipped_, nullptr);
    if (before != nullptr) agent.session_ = *before;
  }
};

absl::StatusOr<const Answer*> AgentSession::Act(int64_t step, absl::Span<const float> observation,
                                                double reward,
                                                const std::optional<ReportedAction>& executed) {
  ActCall call = {.session = this,
                  .step = step,
                  .observation = observation,
                  .reward = reward,
                  .executed = executed};
  ActTogether(absl::MakeSpan(&call, 1));
  return std::move(call.answer);
}

void AgentSession::ActTogether(absl::Span<ActCall> calls) {
  thread_local std::vector<ActCall*> new_decisions;
  new_decisions.clear();
  for (ActCall& call : calls) {
    if (Together::IsNewDecision(call)) new_decisions.push_back(&call);
  }
  ForEachVersion(
      new_decisions, [](const ActCall* call) { return call->session->served_.get(); },
      [](absl::Span<ActCall* const> part) { Together::Decide(part); });
}

bool AgentSession::Together::IsNewDecision(ActCall& call) {
  const Session& session = call.session->session_;
  const bool names_last = !call.decision.has_value() || *call.decision + 1 == session.decisions;
  call.is_retry =
      session.last_answer.has_value() && call.step == session.last_answer->step && names_last;
  if (call.is_retry) {
    call.answer = &*session.last_answer;
    // A store may hold an answer of a server that did not check it.
    if (!IsFinite(*session.last_answer)) call.answer = call.session->NonFiniteError();
    const RepeatedStep repeated = {.step = call.step,
                                   .observation = call.observation,
                                   .reward = call.reward,
                                   .executed = call.executed};
    if (const auto status =
            CheckRepeatedStep(repeated, call.session->policy().action_space, session);
        !status.ok()) {
      call.answer = status;
    }
    return false;
  }
  absl::Status status = call.session->CheckNewDecision(call);
  if (call.decision.has_value() && *call.decision != session.decisions) {
    status = absl::FailedPreconditionError(
        absl::StrCat("decision: expected ", session.decisions, ", received ", *call.decision));
  }
  if (!status.ok()) {
    call.answer = status;
    RestoreSkipped(*call.session);
  }
  return status.ok();
}

void AgentSession::Together::Decide(absl::Span<ActCall* const> calls) {
  auto& [sessions, decisions, outputs, choice] = ThreadScratch();
  const ServedPolicy& served = *calls[0]->session->served_;
  const Clock& clock = *calls[0]->session->clock_;
  absl::Duration last = clock.Now();
  sessions.clear();
  for (const ActCall* call : calls) {
    AgentSession& session = *call->session;
    session.head_.TakeMerged(&session.session_);
    sessions.push_back(&session);
    if (call->executed.has_value() && session.session_.step > 0) {
      session.TakeExecuted(*ParseExecutedAction(*call->executed, served.policy().action_space));
    }
    session.context_.Fill(served, session.session_);
  }
  AppendActions(sessions);
  decisions.clear();
  if (outputs.size() < calls.size()) outputs.resize(calls.size());
  for (size_t i = 0; i < calls.size(); ++i) {
    AgentSession& session = *calls[i]->session;
    const double reward = CountedReward(session.session_, calls[i]->reward);
    const double return_to_go = NextReturnToGo(session.session_, reward);
    decisions.push_back({session.context_.StartDecision(), static_cast<float>(return_to_go),
                         calls[i]->observation, &outputs[i]});
  }
  served.engine->DecideTogether(decisions);

  const absl::Duration decided = clock.Now();
  const absl::Duration share = (decided - last) / static_cast<int64_t>(calls.size());
  last = decided;
  for (size_t i = 0; i < calls.size(); ++i) {
    ActCall& call = *calls[i];
    AgentSession& session = *call.session;
    session.head_.Choose(session.session_, outputs[i].readout, &choice);
    // Probabilities and actions are finite where the logits are.
    if (!AllFinite(choice.logits)) {
      session.context_.Drop();  // it holds the decision that was not made
      RestoreSkipped(session);
      call.answer = session.NonFiniteError();
      continue;
    }
    CheckWiring(session, call.observation);
    Answer answer = MakeAnswer(session, outputs[i], call.reward, &choice);
    answer.unusual_observations =
        served.observer->CountUnusual(call.observation, static_cast<double>(answer.return_to_go));
    const absl::Duration chosen = clock.Now();
    answer.compute_seconds = absl::ToDoubleSeconds(share + (chosen - last));
    last = chosen;
    Record(call, std::move(answer), outputs[i].readout, choice.noise);
    const Answer& answered = *session.session_.last_answer;
    session.life_.OnDecision(chosen - session.created_, answered.counts.total_spikes(),
                             answered.compute_seconds);
    call.answer = &answered;
    call.is_beat ? served.observer->OnBeat(answered) : served.observer->OnDecision(answered);
  }
}

void AgentSession::Together::CheckWiring(AgentSession& agent, absl::Span<const float> observation) {
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
Answer AgentSession::Together::MakeAnswer(AgentSession& agent, const Engine::Output& output,
                                          double reward, ActionChoice* choice) {
  Session& session = agent.session_;
  const double counted = CountedReward(session, reward);
  Answer answer = session.last_answer.has_value() ? *std::move(session.last_answer) : Answer();
  answer.step = session.step;
  answer.return_to_go = static_cast<float>(NextReturnToGo(session, counted));
  answer.counts = output.counts;
  agent.head_.OnDecision(*choice, output.readout, static_cast<double>(answer.return_to_go), counted,
                         &session);
  std::swap(answer.action, choice->action);
  std::swap(answer.logits, choice->logits);
  std::swap(answer.probabilities, choice->probabilities);
  return answer;
}

void AgentSession::Together::Record(ActCall& call, Answer answer, absl::Span<const float> readout,
                                    absl::Span<const float> noise) {
  AgentSession& agent = *call.session;
  const Policy& policy = agent.policy();
  DecisionInputs inputs = {.reward = CountedReward(agent.session_, call.reward),
                           .readout = readout,
                           .noise = noise,
                           .is_beat = call.is_beat,
                           .after_gap = std::exchange(agent.before_skipped_, nullptr) != nullptr,
                           .is_safe = agent.acts_safely()};
  CountDecision(policy, std::move(answer), call.observation, inputs.reward, &agent.session_);
  if (inputs.is_safe) agent.ActSafely();
  if (agent.listeners_.empty()) return;
  if (call.executed.has_value() && call.step > 0) {
    inputs.executed = *ParseExecutedAction(*call.executed, policy.action_space);
  }
  for (const auto& listener : agent.listeners_) listener->OnDecision(agent.session_, inputs);
}

absl::Status AgentSession::CheckNewDecision(const ActCall& call) const {
  const Policy& policy = served_->policy();
  if (call.step != session_.step) {
    return absl::FailedPreconditionError(
        absl::StrCat("step: expected ", session_.step, ", received ", call.step));
  }
  if (auto status = CheckObservation(call.observation, policy.observation_size()); !status.ok()) {
    return status;
  }
  if (call.step == 0) return absl::OkStatus();
  if (call.executed.has_value()) {
    RETURN_IF_ERROR(ParseExecutedAction(*call.executed, policy.action_space).status());
  }
  return CheckReward(call.reward, NextReturnToGo(session_, call.reward));
}

void AgentSession::TakeExecuted(const Action& executed) {
  SPIKESERVE_DCHECK(!session_.history.empty());
  SPIKESERVE_DCHECK(policy().action_space.Contains(executed).ok());
  if (executed == session_.history.action(session_.history.size() - 1)) return;
  context_.OnExecuted();
  head_.OnExecuted(executed, &session_);
  for (const auto& listener : listeners_) listener->OnExecuted(executed);
}

void AgentSession::ActSafely() {
  const Action neutral = NeutralAction(policy().action_space);
  if (neutral == session_.last_answer->action) return;
  head_.OnExecuted(neutral, &session_);
  session_.last_answer->action = neutral;
}

absl::Status AgentSession::NonFiniteError() const {
  served_->observer->OnNonFinite();
  for (const auto& listener : listeners_) listener->OnFailure();
  return absl::InternalError(
      absl::StrCat("decision: expected finite numbers, received NaN or infinity from policy ",
                   served_->name, " version ", served_->version, "; the session has not changed"));
}

void AgentSession::AppendPendingAction() {
  AgentSession* const session = this;
  AppendPendingActions(absl::MakeConstSpan(&session, 1));
}

void AgentSession::AppendPendingActions(absl::Span<AgentSession* const> sessions) {
  thread_local std::vector<AgentSession*> certain;
  certain.clear();
  for (AgentSession* session : sessions) {
    if (!session->context_.expects_executed()) certain.push_back(session);
  }
  Together::AppendActions(certain);
}

void AgentSession::Together::AppendActions(absl::Span<AgentSession* const> sessions) {
  thread_local std::vector<AgentSession*> pending;
  pending.clear();
  for (AgentSession* session : sessions) {
    if (session->context_.TakePending()) pending.push_back(session);
  }
  const auto append = [](absl::Span<AgentSession* const> part) {
    thread_local std::vector<std::vector<float>> encoded;
    thread_local std::vector<Engine::TakenAction> taken;
    taken.clear();
    if (encoded.size() < part.size()) encoded.resize(part.size());
    const ServedPolicy& served = *part[0]->served_;
    for (size_t i = 0; i < part.size(); ++i) {
      taken.push_back(part[i]->context_.LastAction(served, part[i]->session_, &encoded[i]));
    }
    served.engine->AppendActionsTogether(taken);
  };
  ForEachVersion(
      pending, [](const AgentSession* session) { return session->served_.get(); }, append);
}

absl::Status AgentSession::Append(absl::Span<const float> observation, double reward,
                                  const std::optional<ReportedAction>& executed) {
  ActCall call = {.session = this,
                  .step = session_.step,
                  .observation = observation,
                  .reward = reward,
                  .decision = session_.decisions,  // so that it is never a retry
                  .executed = executed,
                  .is_beat = true};
  ActTogether(absl::MakeSpan(&call, 1));
  return call.answer.status();
}

void AgentSession::SkipSteps(absl::Span<const double> rewards) {
  head_.TakeMerged(&session_);
  if (before_skipped_ == nullptr) before_skipped_ = std::make_unique<const Session>(session_);
  for (const double reward : rewards) CountSkipped(reward, &session_);
  session_.history.Clear();
  DropContext();
  for (const auto& listener : listeners_) listener->OnGap();
}

void AgentSession::ReportExecuted(const Action& executed) {
  if (executed == session_.history.action(session_.history.size() - 1)) return;
  TakeExecuted(executed);
  for (const auto& listener : listeners_) listener->OnChange(session_);
}

absl::StatusOr<EpisodeSummary> AgentSession::EndEpisode(const EpisodeEnd& end) {
  if (session_.step == 0) return RepeatEnd(end);
  auto summary = Together::End(end, *this);
  if (!summary.ok()) Together::RestoreSkipped(*this);
  before_skipped_ = nullptr;
  return summary;
}

absl::StatusOr<EpisodeSummary> AgentSession::Together::End(const EpisodeEnd& end,
                                                           AgentSession& agent) {
  Session& session = agent.session_;
  agent.head_.TakeMerged(&session);
  if (auto status = CheckReward(end.reward, NextReturnToGo(session, end.reward)); !status.ok()) {
    return status;
  }
  if (!end.observation.empty()) {
    if (auto status = CheckObservation(end.observation, agent.served_->policy().observation_size());
        !status.ok()) {
      return status;
    }
  }
  const double target_return = end.target_return.value_or(session.options.target_return);
  RETURN_IF_ERROR(CheckTargetReturn(target_return));
  if (agent.contribution() != nullptr) {
    return absl::UnavailableError(
        "fleet head: has not taken the last episode of the session yet; try again");
  }

  const bool is_known = !session.history.empty();  // otherwise the last steps were skipped
  if (is_known && end.executed_action.has_value()) agent.TakeExecuted(*end.executed_action);
  // As it was executed, however the agent has reported that, so that the same end is known again.
  EpisodeEnd taken = end;
  if (is_known) taken.executed_action = session.history.action(session.history.size() - 1);
  const double episode_return = session.episode_return + end.reward;
  const EpisodeSummary summary = {
      .episode_return = episode_return,
      .steps = session.step,
      .spikes = session.episode_spikes,
      .energy_joules = session.episode_energy_joules,
      .learning = agent.head_.OnEpisodeEnd(end, episode_return, *agent.clock_, &session)};
  ++session.episode;
  session.step = 0;
  session.target_return = target_return;
  session.return_to_go = target_return;
  session.episode_return = 0.0;
  session.episode_spikes = 0;
  session.episode_energy_joules = 0.0;
  session.history.Clear();
  session.last_answer.reset();
  session.last_end = std::make_shared<const EndedEpisode>(
      EndedEpisode{.end = std::move(taken), .summary = summary});
  agent.DropContext();
  agent.head_.NewContribution(session);
  bool is_taken = false;
  for (const auto& listener : agent.listeners_) {
    if (listener->OnEpisodeEnd(session, agent.contribution())) is_taken = true;
  }
  if (agent.contribution() != nullptr && !is_taken) agent.contribution()->Append();
  agent.life_.OnEpisode(summary.episode_return);
  agent.served_->observer->OnEpisodeEnd(summary.episode_return);
  return summary;
}

absl::StatusOr<EpisodeSummary> AgentSession::RepeatEnd(const EpisodeEnd& end) {
  head_.TakeMerged(&session_);
  if (session_.last_end != nullptr && IsSameEnd(session_.last_end->end, end)) {
    return session_.last_end->summary;
  }
  if (session_.step > 0) {
    return absl::FailedPreconditionError(
        "episode: expected the same end as before, received another one");
  }
  return absl::FailedPreconditionError(
      "step: expected at least one decision since the last episode ended, received none");
}

void AgentSession::CountMissingRewards(int64_t rewards) {
  if (rewards == 0) return;
  life_.OnMissingRewards(rewards);
  served_->observer->OnMissingRewards(rewards);
}

void AgentSession::Compact() {
  DropContext();
  session_.history.ShrinkToFit();
}

}  // namespace spikeserve
