#include "core/session/agent_session.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <utility>
#include <vector>

#include "absl/base/attributes.h"
#include "absl/strings/str_cat.h"
#include "core/action/action_head.h"
#include "core/contract/dcheck.h"
#include "core/learning/frobenius_norm.h"
#include "core/learning/held_out.h"
#include "core/math/counter_random.h"
#include "core/math/vector_view.h"
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
      life_(session_.decisions, session_.episode) {
  const Policy& policy = served_->policy();
  if (session_.options.learning.has_value() && !session_.learner.has_value()) {
    Eigen::VectorXf delta = session_.options.head_delta;
    if (delta.size() == 0) delta.setZero(AsVector(policy.weights.head.weight.values).size());
    session_.learner = Learner::New(*session_.options.learning, policy, std::move(delta));
  }
  if (session_.options.learning.has_value() && session_.options.learning->scope == Scope::kFleet) {
    const std::string& tenant = session_.options.tenant;
    const bool by_tenant = served_->SharesHead(tenant) && !tenant.empty();
    member_ = std::make_unique<FleetHead::Member>(
        served_->HeadOf(tenant), by_tenant ? tenant : session_.id, IsHeldOut(session_.id));
    if (served_->log == nullptr) session_.pending = nullptr;
    if (session_.pending != nullptr) contribution_ = NewContribution();
    return;
  }
  const Eigen::VectorXf delta = HeadDelta();
  if (delta.size() > 0) head_ = HeadWith(policy, delta);
}

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
    if (IsNewDecision(call)) new_decisions.push_back(&call);
  }
  ForEachVersion(
      new_decisions, [](const ActCall* call) { return call->session->served_.get(); },
      [](absl::Span<ActCall* const> part) { Decide(part); });
}

bool AgentSession::IsNewDecision(ActCall& call) {
  const Session& session = call.session->session_;
  const bool names_last = !call.decision.has_value() || *call.decision + 1 == session.decisions;
  call.is_retry =
      session.last_answer.has_value() && call.step == session.last_answer->step && names_last;
  if (call.is_retry) {
    call.answer = &*session.last_answer;
    // A store may hold an answer of a server that did not check it.
    if (!IsFinite(*session.last_answer)) call.answer = call.session->NonFiniteError();
    return false;
  }
  absl::Status status = call.session->CheckRequest(call);
  if (call.decision.has_value() && *call.decision != session.decisions) {
    status = absl::FailedPreconditionError(
        absl::StrCat("decision: expected ", session.decisions, ", received ", *call.decision));
  }
  if (!status.ok()) call.answer = status;
  return status.ok();
}

void AgentSession::Decide(absl::Span<ActCall* const> calls) {
  auto& [sessions, decisions, outputs, choice] = ThreadScratch();
  const ServedPolicy& served = *calls[0]->session->served_;
  const Clock& clock = *calls[0]->session->clock_;
  absl::Duration last = clock.Now();
  sessions.clear();
  for (const ActCall* call : calls) {
    AgentSession& session = *call->session;
    session.TakeMerged();
    sessions.push_back(&session);
    if (call->executed.has_value() && session.session_.step > 0) {
      session.TakeExecuted(*ParseExecutedAction(*call->executed, served.policy().action_space));
    }
    if (session.context_ == nullptr) session.RebuildContext();
  }
  AppendActions(sessions);
  decisions.clear();
  if (outputs.size() < calls.size()) outputs.resize(calls.size());
  for (size_t i = 0; i < calls.size(); ++i) {
    AgentSession& session = *calls[i]->session;
    const double return_to_go =
        NextReturnToGo(session.session_, session.CountedReward(calls[i]->reward));
    decisions.push_back({session.context_.get(), static_cast<float>(return_to_go),
                         calls[i]->observation, &outputs[i]});
    session.action_pending_ = true;
  }
  served.engine->DecideTogether(decisions);

  const absl::Duration decided = clock.Now();
  const absl::Duration share = (decided - last) / static_cast<int64_t>(calls.size());
  last = decided;
  for (size_t i = 0; i < calls.size(); ++i) {
    ActCall& call = *calls[i];
    AgentSession& session = *call.session;
    const double reward = session.CountedReward(call.reward);
    const double return_to_go = NextReturnToGo(session.session_, reward);
    session.ChooseWithHead(outputs[i].readout, &choice);
    // Probabilities and actions are finite where the logits are.
    if (!AllFinite(choice.logits)) {
      session.DropContext();  // it holds the decision that was not made
      if (const auto before = std::exchange(session.before_skipped_, nullptr)) {
        session.session_ = *before;
      }
      call.answer = session.NonFiniteError();
      continue;
    }
    Answer answer = session.TakeChoice(outputs[i], return_to_go, reward, &choice);
    answer.unusual_observations = served.observer->CountUnusual(call.observation);
    const absl::Duration chosen = clock.Now();
    answer.compute_seconds = absl::ToDoubleSeconds(share + (chosen - last));
    last = chosen;
    session.Record(std::move(answer), call.observation, reward);
    session.WriteToJournal(call, reward, outputs[i].readout, choice.noise);
    const Answer& answered = *session.session_.last_answer;
    session.life_.OnDecision(chosen - session.created_, answered.counts.total_spikes(),
                             answered.compute_seconds);
    call.answer = &answered;
    if (call.is_beat) {
      served.observer->OnBeat(answered);
      continue;
    }
    served.observer->OnDecision(answered);
    if (session.evidence_ != nullptr) session.evidence_->OnDecision(answered.compute_seconds);
  }
}

absl::Status AgentSession::CheckRequest(const ActCall& call) const {
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
    const auto executed = ParseExecutedAction(*call.executed, policy.action_space);
    if (!executed.ok()) return executed.status();
  }
  return CheckReward(call.reward, NextReturnToGo(session_, call.reward));
}

void AgentSession::TakeExecuted(const Action& executed) {
  SPIKESERVE_DCHECK(!session_.history.empty());
  SPIKESERVE_DCHECK(served_->policy().action_space.Contains(executed).ok());
  if (executed == session_.history.action(session_.history.size() - 1)) return;
  if (!action_pending_) context_.reset();  // it holds the answered action
  reports_actions_ = true;
  if (session_.learner.has_value() && served_->learning->paused()) {
    session_.learner->suspended = true;
  }
  const auto outcome = ReplaceLastAction(served_->policy(), executed, &session_);
  if (outcome.has_value() && !InFleet()) {
    HeadWith(served_->policy(), session_.learner->head_delta, &*head_);
  }
  // The observer has counted the update that an applied one replaces.
  if (outcome.has_value() && *outcome != UpdateOutcome::kApplied) {
    served_->observer->OnHeadUpdate(*outcome);
  }
  if (recorder_ != nullptr) recorder_->OnExecuted(executed);
}

absl::Status AgentSession::NonFiniteError() const {
  served_->observer->OnNonFinite();
  if (evidence_ != nullptr) evidence_->OnFailure();
  return absl::InternalError(
      absl::StrCat("decision: expected finite numbers, received NaN or infinity from policy ",
                   served_->name, " version ", served_->version, "; the session has not changed"));
}

// Reuses the memory of the session's last answer.
Answer AgentSession::TakeChoice(const Engine::Output& output, double return_to_go, double reward,
                                ActionChoice* choice) {
  Answer answer = session_.last_answer.has_value() ? *std::move(session_.last_answer) : Answer();
  answer.step = session_.step;
  answer.return_to_go = static_cast<float>(return_to_go);
  answer.counts = output.counts;

  if (session_.learner.has_value()) {
    if (served_->learning->paused()) session_.learner->suspended = true;
    TakeOutcome(session_.learner->OnDecision(*session_.options.learning, served_->policy(), *choice,
                                             output.readout,
                                             static_cast<double>(answer.return_to_go), reward));
  }
  std::swap(answer.action, choice->action);
  std::swap(answer.logits, choice->logits);
  std::swap(answer.probabilities, choice->probabilities);
  return answer;
}

void AgentSession::ChooseWithHead(absl::Span<const float> readout, ActionChoice* choice) const {
  const ActionSelection& selection = session_.options.action_selection;
  // A greedy choice reads no random number.
  const uint64_t random =
      selection.sample ? RandomBits({session_.options.seed, session_.decisions}) : 0;
  const auto choose = [&](const Linear& head) {
    ChooseAction(head, served_->policy().action_space, readout, selection, random, choice);
  };
  if (InFleet()) return choose(member_->head().Read()->head);
  choose(head_ ? *head_ : served_->policy().weights.head);
}

// Updates the private head and reports the outcome to the observer. An update that a fleet session
// applies to its contribution is not reported here: the merge at the end of the episode reports the
// outcome for the fleet head.
void AgentSession::TakeOutcome(std::optional<UpdateOutcome> outcome) {
  if (!outcome.has_value()) return;
  if (*outcome == UpdateOutcome::kApplied) {
    if (InFleet()) return;
    HeadWith(served_->policy(), session_.learner->head_delta, &*head_);
  }
  served_->observer->OnHeadUpdate(*outcome);
}

void AgentSession::Record(Answer answer, absl::Span<const float> observation, double reward) {
  CountDecision(served_->policy(), std::move(answer), observation, reward, &session_);
  if (recorder_ != nullptr) recorder_->OnDecision(session_, observation, reward);
}

void AgentSession::WriteToJournal(const ActCall& call, double reward,
                                  absl::Span<const float> readout, absl::Span<const float> noise) {
  const bool after_skipped = std::exchange(before_skipped_, nullptr) != nullptr;
  if (journal_ == nullptr) return;
  if (after_skipped) return journal_->OnChange(session_);
  JournalEntryView entry = {.decision = session_.decisions - 1,
                            .reward = reward,
                            .observation = call.observation,
                            .executed = std::nullopt,
                            .answer = *session_.last_answer,
                            .readout = {},
                            .noise = {}};
  if (call.executed.has_value() && call.step > 0) {
    entry.executed = *ParseExecutedAction(*call.executed, served_->policy().action_space);
  }
  if (session_.learner.has_value()) {
    entry.readout = readout;
    entry.noise = noise;
    entry.suspended = session_.learner->suspended;
  }
  journal_->OnDecision(session_, entry);
}

void AgentSession::AppendPendingAction() {
  AgentSession* const session = this;
  AppendPendingActions(absl::MakeConstSpan(&session, 1));
}

void AgentSession::AppendPendingActions(absl::Span<AgentSession* const> sessions) {
  thread_local std::vector<AgentSession*> certain;
  certain.clear();
  for (AgentSession* session : sessions) {
    if (!session->reports_actions_) certain.push_back(session);
  }
  AppendActions(certain);
}

void AgentSession::AppendActions(absl::Span<AgentSession* const> sessions) {
  thread_local std::vector<AgentSession*> pending;
  pending.clear();
  for (AgentSession* session : sessions) {
    if (std::exchange(session->action_pending_, false)) pending.push_back(session);
  }
  const auto append = [](absl::Span<AgentSession* const> part) {
    thread_local Action action;
    thread_local std::vector<std::vector<float>> encoded;
    thread_local std::vector<Engine::TakenAction> taken;
    taken.clear();
    if (encoded.size() < part.size()) encoded.resize(part.size());
    for (size_t i = 0; i < part.size(); ++i) {
      const History& history = part[i]->session_.history;
      history.action(history.size() - 1, &action);
      taken.push_back({part[i]->context_.get(), part[i]->EncodedAction(action, &encoded[i])});
    }
    part[0]->served_->engine->AppendActionsTogether(taken);
  };
  ForEachVersion(
      pending, [](const AgentSession* session) { return session->served_.get(); }, append);
}

absl::Span<const float> AgentSession::EncodedAction(const Action& action,
                                                    std::vector<float>* encoded) const {
  const ActionSpace& space = served_->policy().action_space;
  encoded->resize(static_cast<size_t>(space.size()));
  space.Encode(action, absl::MakeSpan(*encoded));
  return *encoded;
}

// Replays the history: the same calls with the same numbers leave the same keys and values in the
// context.
void AgentSession::RebuildContext() {
  const Engine& engine = *served_->engine;
  const auto first_timestep = session_.step - static_cast<int64_t>(session_.history.size());
  context_ = engine.NewContext(session_.options.seed, first_timestep);
  action_pending_ = false;
  Engine::Output ignored;
  std::vector<float> encoded;
  const History& history = session_.history;
  for (size_t i = 0; i < history.size(); ++i) {
    engine.Decide(*context_, history.return_to_go(i), history.observation(i), &ignored);
    engine.AppendAction(*context_, EncodedAction(history.action(i), &encoded));
  }
}

absl::StatusOr<EpisodeSummary> AgentSession::EndEpisode(const EpisodeEnd& end) {
  TakeMerged();
  if (session_.step == 0) {
    if (session_.last_end != nullptr && session_.last_end->end == end) {
      return session_.last_end->summary;
    }
    return absl::FailedPreconditionError(
        "step: expected at least one decision since the last episode ended, received none");
  }
  if (auto status = CheckReward(end.reward, NextReturnToGo(session_, end.reward)); !status.ok()) {
    return status;
  }
  if (!end.observation.empty()) {
    if (auto status = CheckObservation(end.observation, served_->policy().observation_size());
        !status.ok()) {
      return status;
    }
  }
  const double target_return = end.target_return.value_or(session_.options.target_return);
  if (auto status = CheckTargetReturn(target_return); !status.ok()) return status;
  if (contribution_ != nullptr) {
    return absl::UnavailableError(
        "fleet head: has not taken the last episode of the session yet; try again");
  }

  if (end.executed_action.has_value()) TakeExecuted(*end.executed_action);
  if (recorder_ != nullptr) {
    recorder_->OnEnd(end.reward, end.observation, end.terminated, end.truncated);
  }
  const double episode_return = session_.episode_return + end.reward;
  const EpisodeSummary summary = {.episode_return = episode_return,
                                  .steps = session_.step,
                                  .spikes = session_.episode_spikes,
                                  .energy_joules = session_.episode_energy_joules,
                                  .learning = LearnFromEpisode(end, episode_return)};
  ++session_.episode;
  session_.step = 0;
  session_.target_return = target_return;
  session_.return_to_go = target_return;
  session_.episode_return = 0.0;
  session_.episode_spikes = 0;
  session_.episode_energy_joules = 0.0;
  session_.history.Clear();
  session_.last_answer.reset();
  session_.last_end =
      std::make_shared<const EndedEpisode>(EndedEpisode{.end = end, .summary = summary});
  DropContext();
  if (session_.pending != nullptr) contribution_ = NewContribution();
  if (journal_ != nullptr) {
    journal_->OnEpisodeEnd(session_, contribution_);
  } else if (contribution_ != nullptr) {
    contribution_->Append();
  }
  life_.OnEpisode(summary.episode_return);
  served_->observer->OnEpisodeEnd(summary.episode_return);
  if (evidence_ != nullptr) evidence_->OnEpisodeEnd(summary.episode_return);
  return summary;
}

std::optional<LearningSummary> AgentSession::LearnFromEpisode(const EpisodeEnd& end,
                                                              double episode_return) {
  if (!session_.learner.has_value()) return std::nullopt;
  const LearningOptions& options = *session_.options.learning;
  Learner& learner = *session_.learner;
  if (served_->learning->paused()) learner.suspended = true;
  TakeOutcome(learner.OnEpisodeEnd(options, served_->policy(), end.reward, end.terminated));
  LearningSummary summary = {.scope = options.scope,
                             .updates = learner.updates,
                             .rejected = learner.rejected,
                             .returns = learner.returns};
  InFleet() ? MergeIntoFleet(episode_return, &summary) : WatchPrivateHead(episode_return, &summary);
  learner.StartEpisode(options);
  if (session_.pending == nullptr) served_->observer->OnLearned(summary);
  return summary;
}

void AgentSession::MergeIntoFleet(double episode_return, LearningSummary* summary) {
  FleetHead& fleet = member_->head();
  std::shared_ptr<const FleetHead::Snapshot> snapshot;
  const bool is_logged = served_->log != nullptr;
  const auto merge = [&] {
    FleetHead::Merged merged = fleet.Merge(session_.learner->head_delta, episode_return,
                                           {.contributor = member_->contributor(),
                                            .held_out = member_->held_out(),
                                            .now = clock_->Now()});
    served_->observer->OnHeadUpdate(merged.outcome);
    if (IsRefusedByFleet(merged.outcome)) summary->rejected += std::exchange(summary->updates, 0);
    summary->rolled_back = merged.rolled_back;
    snapshot = std::move(merged.snapshot);
  };
  const bool merged =
      !is_logged && !session_.learner->suspended && served_->learning->MergeUnlessPaused(merge);
  if (!merged) snapshot = fleet.Read();
  summary->head_drift = snapshot->drift;
  summary->watched_return = snapshot->level.mean;
  if (!is_logged || session_.learner->suspended) return;
  session_.pending = std::make_shared<const PendingContribution>(
      PendingContribution{.episode = session_.episode,
                          .delta = session_.learner->head_delta,
                          .episode_return = episode_return,
                          .summary = *summary});
}

std::shared_ptr<FleetContribution> AgentSession::NewContribution() const {
  const std::string& tenant = session_.options.tenant;
  return std::make_shared<FleetContribution>(served_, session_.id,
                                             served_->SharesHead(tenant) ? "" : tenant,
                                             member_->contributor(), session_.pending);
}

void AgentSession::TakeMerged() {
  if (contribution_ == nullptr) return;
  const auto merged = contribution_->merged();
  if (!merged.has_value()) return;
  contribution_ = nullptr;
  session_.pending = nullptr;
  if (session_.last_end == nullptr) return;
  EndedEpisode ended = *session_.last_end;
  ended.summary.learning = *merged;
  session_.last_end = std::make_shared<const EndedEpisode>(std::move(ended));
}

void AgentSession::WatchPrivateHead(double episode_return, LearningSummary* summary) {
  Learner& learner = *session_.learner;
  if (!learner.suspended) {
    summary->rolled_back = learner.Watch(*session_.options.learning, episode_return);
  }
  if (summary->rolled_back) head_ = HeadWith(served_->policy(), learner.head_delta);
  summary->head_drift = HeadDrift();
  summary->watched_return = learner.guard.last.mean;
}

Eigen::VectorXf AgentSession::HeadDelta() const {
  if (InFleet()) return member_->head().Read()->delta;
  return session_.learner.has_value() ? session_.learner->head_delta : session_.options.head_delta;
}

double AgentSession::HeadDrift() const {
  if (InFleet()) return member_->head().Read()->drift;
  return FrobeniusNorm(HeadDelta()) / BaseNorm(served_->policy());
}

int64_t AgentSession::Rollbacks() const {
  if (InFleet()) return member_->head().Read()->rollbacks;
  return session_.learner.has_value() ? session_.learner->guard.rollbacks : 0;
}

void AgentSession::DropContext() {
  context_.reset();
  action_pending_ = false;
}

void AgentSession::Compact() {
  DropContext();
  session_.history.ShrinkToFit();
}

}  // namespace spikeserve
