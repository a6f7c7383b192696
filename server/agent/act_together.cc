#include "server/agent/act_together.h"

#include <cstdint>
#include <optional>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/container/inlined_vector.h"
#include "core/contract/dcheck.h"
#include "core/open_sessions/session_locks.h"
#include "server/agent/beat_requests.h"
#include "server/agent/episode_end.h"
#include "server/agent/request_order.h"
#include "server/agent/session_gate.h"
#include "server/messages/convert.h"

namespace spikeserve {
namespace {

// Returns the step that the session's shadow will replay for the decision that was just made. If
// the agent `reports` executed actions, the history has the one before it.
ShadowStep MakeShadowStep(absl::Span<const float> observation, double reward, bool reports,
                          const Session& session) {
  std::optional<Action> executed;
  if (reports && session.last_answer->step > 0 && session.history.size() > 1) {
    executed = session.history.action(session.history.size() - 2);
  }
  return {.episode = session.episode,
          .step = session.last_answer->step,
          .observation = {observation.begin(), observation.end()},
          .reward = reward,
          .target_return = session.target_return,
          .executed = std::move(executed),
          .served = *session.last_answer};
}

// Returns the number of the decision that the request names, if it names one.
std::optional<uint64_t> Decision(const DecisionRequest& act) {
  if (act.is_next || !act.request->has_decision()) return std::nullopt;
  return act.request->decision();
}

// Adds what the answer waits for. Errors wait, too, so that the answers of one session keep their
// order; the items of a batch are answered together, so that an error among them need not.
void AddCommits(DecisionRequest& act, const Place& place, bool has_decided) {
  Commits& commits = act.context->commits;
  const size_t before = commits.size();
  if (place.is_of_session) {
    AddCommit(*act.entry, &commits);
  } else {
    AddConfirmation(*act.entry, has_decided, &commits);
  }
  if (commits.size() == before || act.item < 0) return;
  if (act.status.ok()) {
    commits.back().item = act.item;
  } else {
    commits.pop_back();
  }
}

// Takes the beats of a request. Returns whether the decision is to be made now.
bool TakeBeatsOf(DecisionRequest& act, const Clock& clock, BeatBudget* budget)
    ABSL_EXCLUSIVE_LOCKS_REQUIRED(act.entry->mutex) {
  SessionEntry& entry = *act.entry;
  const bool is_new = entry.journal == nullptr || entry.journal->is_new();
  const auto on_appended = [&](const Beat& beat) {
    entry.mutex.AssertHeld();
    if (entry.shadow == nullptr) return;
    entry.shadow_steps.push_back(
        MakeShadowStep(beat.observation, beat.reward, /*reports=*/true, entry.agent.session()));
  };
  const auto decides = TakeBeats(*act.request, act.received, clock, *entry.served->observer, is_new,
                                 &entry.agent, &entry.robot, budget, &act.beats, on_appended);
  act.status = decides.status();
  return decides.ok() && *decides;
}

// Adds to the span of a decision what it was.
void Describe(const DecisionRequest& act, bool is_retry, Span* span)
    ABSL_EXCLUSIVE_LOCKS_REQUIRED(act.entry->mutex) {
  const ServedPolicy& served = *act.entry->served;
  const Session& session = act.entry->agent.session();
  span->Set("spikeserve.policy", served.name);
  span->Set("spikeserve.policy.version", served.version);
  span->Set("spikeserve.session.id", session.id);
  span->Set("spikeserve.episode", session.episode);
  span->Set("spikeserve.step", session.last_answer->step);
  const v1::DecisionStats& stats = act.response->stats();
  span->Set("spikeserve.spikes", static_cast<int64_t>(stats.spikes()));
  span->Set("spikeserve.synaptic_operations", static_cast<int64_t>(stats.synaptic_operations()));
  span->Set("spikeserve.energy_joules", stats.energy_joules());
  span->Set("spikeserve.compute_seconds", stats.compute_seconds());
  if (is_retry) span->Set("spikeserve.is_retry", int64_t{1});
}

// Sets what follows from `act.status`. `is_new` is true if the session has changed.
void Conclude(DecisionRequest& act, bool is_new) ABSL_EXCLUSIVE_LOCKS_REQUIRED(act.entry->mutex) {
  SessionEntry& entry = *act.entry;
  entry.mutex.AssertHeld();
  const Place place = PlaceOf(*act.request);
  if (absl::IsFailedPrecondition(act.status)) {
    act.status = SessionGate::Refused(*act.context, place, act.status, entry);
    if (absl::IsNotFound(act.status)) return;
  }
  const bool has_decided = act.status.ok() && is_new;
  const size_t waits = act.context->commits.size();
  AddCommits(act, place, has_decided);
  if (has_decided && act.context->commits.size() == waits)
    SessionGate::Trace(act.context->span, entry);
  if (!act.status.ok()) return entry.served->observer->OnError();
  if (const SessionJournal* journal = entry.journal.get(); journal != nullptr) {
    act.response->set_durable_decision(journal->is_sync() ? entry.agent.session().decisions
                                                          : journal->durable_decisions());
    if (HasBeats(*act.request) || act.request->has_end_episode()) {
      act.response->set_durable_episode(journal->is_sync() ? entry.agent.session().episode
                                                           : journal->durable_episodes());
    }
  }
}

// Ends the episode of a request with end_episode, behind its history. The history of a request that
// was answered before is known.
void TakeEnd(DecisionRequest& act, const Clock& clock, BeatBudget* budget)
    ABSL_EXCLUSIVE_LOCKS_REQUIRED(act.entry->mutex) {
  const v1::ActRequest& request = *act.request;
  AgentSession& agent = act.entry->agent;
  const int64_t episode = agent.session().episode;
  act.status = CheckEndBehindHistory(request, agent.policy());
  if (act.status.ok() && request.end_episode().episode() == episode && HasBeats(request)) {
    TakeBeatsOf(act, clock, budget);
    if (!act.is_finished()) return;
  }
  const absl::Duration begun = clock.Now();
  if (act.status.ok()) {
    act.status =
        EndBehindHistory(*act.entry, request, act.context->span, act.response->mutable_ended());
  }
  Conclude(act, /*is_new=*/agent.session().episode > episode);
  if (!act.status.ok()) return act.response->clear_ended();
  FillBeats(request, act.beats, agent.session(), act.received, begun, act.response);
}

// Answers a request whose decision was made by `call`. `begun` is when, if the request has beats.
void AnswerDecision(DecisionRequest& act, const ActCall& call, absl::Duration begun) {
  SessionEntry& entry = *act.entry;
  entry.mutex.AssertHeld();
  act.entry->mutex.AssertHeld();
  act.status = call.answer.status();
  Span span = std::move(act.span);
  Conclude(act, /*is_new=*/!call.is_retry);
  span.Fail(act.status);
  if (!act.status.ok()) return;
  const Session& session = entry.agent.session();
  if (call.is_retry) {
    entry.served->observer->OnRepeated();
  } else if (call.step > 0 && !act.request->has_reward()) {
    entry.agent.CountMissingRewards(1);
  }
  if (entry.shadow != nullptr && !call.is_retry) {
    entry.shadow_steps.push_back(MakeShadowStep(act.request->observation(), act.request->reward(),
                                                call.executed.has_value(), session));
  }
  ToProto(act.request->session_id(), **call.answer, entry.served->policy(), act.response);
  WiringToProto(entry.agent, act.response);
  if (span) Describe(act, call.is_retry, &span);
  if (HasBeats(*act.request)) {
    FillBeats(*act.request, act.beats, session, act.received, begun, act.response);
  }
}

}  // namespace

void DecideActs(absl::Span<DecisionRequest* const> acts, const Clock& clock, BeatBudget* budget) {
  absl::InlinedVector<std::shared_ptr<SessionEntry>, 1> entries;
  for (const DecisionRequest* act : acts) entries.push_back(act->entry);
  SPIKESERVE_DCHECK(std::find(entries.begin(), entries.end(), nullptr) == entries.end());
  SPIKESERVE_DCHECK_EQ(std::set(entries.begin(), entries.end()).size(), entries.size());
  const SessionLocks locks(entries);
  absl::InlinedVector<ActCall, 1> calls;
  absl::InlinedVector<DecisionRequest*, 1> deciding;  // the requests of `calls`
  absl::Duration begun;                               // of the decisions
  for (DecisionRequest* act : acts) {
    act->entry->mutex.AssertHeld();
    AgentSession& agent = act->entry->agent;
    if (act->entry->journal != nullptr) act->entry->journal->WriteAgainIfMissing(agent.session());
    act->beats.finished = true;  // also if it had to wait for another request
    if (act->request->has_end_episode()) {
      TakeEnd(*act, clock, budget);
      continue;
    }
    if (HasBeats(*act->request)) {
      const bool decides = TakeBeatsOf(*act, clock, budget);
      if (!act->is_finished()) continue;
      begun = clock.Now();
      if (!decides) {
        Conclude(*act, /*is_new=*/act->beats.appended > 0);
        if (act->status.ok()) {
          FillBeats(*act->request, act->beats, agent.session(), act->received, begun,
                    act->response);
        }
        continue;
      }
    }
    calls.push_back({.session = &agent,
                     .step = act->is_next ? agent.session().step : act->request->step(),
                     .observation = act->request->observation(),
                     .reward = act->request->reward(),
                     .decision = Decision(*act),
                     .executed = ExecutedBefore(*act->request)});
    act->span = act->context->span.Child("decide");
    deciding.push_back(act);
  }
  AgentSession::ActTogether(absl::MakeSpan(calls));
  for (size_t i = 0; i < calls.size(); ++i) AnswerDecision(*deciding[i], calls[i], begun);
}

}  // namespace spikeserve
