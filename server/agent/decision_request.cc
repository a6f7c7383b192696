#include "server/agent/decision_request.h"

#include <algorithm>
#include <cstdint>
#include <set>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/container/inlined_vector.h"
#include "core/contract/dcheck.h"
#include "core/open_sessions/session_locks.h"
#include "server/agent/session_gate.h"
#include "server/messages/step_convert.h"

namespace spikeserve {
namespace {

// Adds what the answer waits for. Errors wait, too, so that the answers of one session keep their
// order; the items of a batch are answered together, so that an error among them need not.
void AddCommits(DecisionRequest& act, bool has_decided)
    ABSL_EXCLUSIVE_LOCKS_REQUIRED(act.entry->mutex) {
  const SessionEntry& entry = *act.entry;
  entry.mutex.AssertHeld();
  Commits& commits = act.context->commits;
  const size_t before = commits.size();
  AddCommit(entry, AwaitAt(act.step.place, has_decided), &commits);
  if (commits.size() == before || act.item < 0) return;
  if (act.status.ok()) {
    commits.back().item = act.item;
  } else {
    commits.pop_back();
  }
}

// Adds to the span of a decision what it was.
void Describe(const DecisionRequest& act, Span* span)
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
  if (act.step.result.is_retry) span->Set("spikeserve.is_retry", int64_t{1});
}

// Sets what follows from `act.status`, for the session and for what the answer waits for.
void Acknowledge(DecisionRequest& act) ABSL_EXCLUSIVE_LOCKS_REQUIRED(act.entry->mutex) {
  SessionEntry& entry = *act.entry;
  entry.mutex.AssertHeld();
  if (absl::IsFailedPrecondition(act.status)) {
    act.status = SessionGate::Refused(*act.context, act.step.place, act.status, entry);
    if (absl::IsNotFound(act.status)) return;
  }
  const StepOutcome& result = act.step.result;
  const bool is_new = result.answer == nullptr && !act.step.end.has_value() ? result.appended > 0
                                                                            : !result.is_retry;
  const bool has_decided = act.status.ok() && is_new;
  const size_t waits = act.context->commits.size();
  AddCommits(act, has_decided);
  if (has_decided && act.context->commits.size() == waits) {
    SessionGate::Trace(act.context->span, entry);
  }
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

// Begins the span of what a request asks for.
Span StartSpan(const DecisionRequest& act) ABSL_EXCLUSIVE_LOCKS_REQUIRED(act.entry->mutex) {
  const SessionEntry& entry = *act.entry;
  entry.mutex.AssertHeld();
  if (act.step.end.has_value()) return SessionGate::StartMerge(act.context->span, entry);
  const bool asks = !act.step.observation.empty() || !HasBeats(*act.request);
  return asks ? act.context->span.Child("decide") : Span();
}

// Answers a request whose step was applied.
void TakeResult(DecisionRequest& act, Span span) ABSL_EXCLUSIVE_LOCKS_REQUIRED(act.entry->mutex) {
  const SessionEntry& entry = *act.entry;
  entry.mutex.AssertHeld();
  const StepOutcome& result = act.step.result;
  act.status = result.status;
  if (act.status.ok() && !result.finished) return span.Cancel();
  if (act.status.ok() && result.answer == nullptr && !result.summary.has_value()) span.Cancel();
  Acknowledge(act);
  span.Fail(act.status);
  if (!act.status.ok()) return;
  ToProto(*act.request, act.step, act.received, entry, act.response);
  if (span && result.answer != nullptr) Describe(act, &span);
}

// Holds a session, or does not hold it any more, as the operators have decided since its last
// request.
void TakeHold(const SessionHolds& holds, SessionEntry& entry)
    ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex) {
  const uint64_t revision = holds.revision();
  if (std::exchange(entry.holds_revision, revision) == revision) return;
  entry.agent.SetHold(holds.Find(entry.agent.session()));
}

}  // namespace

void DecisionRequest::Become(DecisionState next) {
  SPIKESERVE_DCHECK(MayFollow(state, next));
  state = next;
}

void DecisionRequest::Conclude() {
  if (status.ok() && !step.result.finished) return;
  // The items of a batch are taken over together, when the batch leaves by the gate.
  const bool claims = item < 0 && context->may_claim && absl::IsNotFound(status);
  Become(claims ? DecisionState::kClaiming : DecisionState::kDecided);
}

void DecisionRequest::OnClaimed(const absl::Status& claimed) {
  context->may_claim = false;
  context->has_claimed = claimed.ok();
  status = claimed;
  step.result.checked = false;  // against another copy of the session
  Become(claimed.ok() ? DecisionState::kWaiting : DecisionState::kDecided);
}

void DecideActs(absl::Span<DecisionRequest* const> acts, const SessionHolds& holds,
                StepBudget* budget) {
  absl::InlinedVector<std::shared_ptr<SessionEntry>, 1> entries;
  for (const DecisionRequest* act : acts) entries.push_back(act->entry);
  SPIKESERVE_DCHECK(std::find(entries.begin(), entries.end(), nullptr) == entries.end());
  SPIKESERVE_DCHECK_EQ(std::set(entries.begin(), entries.end()).size(), entries.size());
  const SessionLocks locks(entries);
  absl::InlinedVector<Step*, 1> steps;
  absl::InlinedVector<Span, 1> spans;
  for (DecisionRequest* act : acts) {
    SessionEntry& entry = *act->entry;
    entry.mutex.AssertHeld();
    act->entry->mutex.AssertHeld();
    if (entry.journal != nullptr) entry.journal->WriteAgainIfMissing(entry.agent.session());
    TakeHold(holds, entry);
    Step& step = act->step;
    step.result.finished = true;  // also if it had to wait for another request
    step.result.status = CheckMayBeHeard(entry);
    if (step.result.status.ok()) {
      step.result.status = ToStep(*act->request, act->received, act->is_next, entry, &step);
    }
    if (step.result.status.ok()) steps.push_back(&step);
    spans.push_back(StartSpan(*act));
  }
  AgentSession::Apply(steps, budget);
  for (size_t i = 0; i < acts.size(); ++i) {
    acts[i]->entry->mutex.AssertHeld();
    TakeResult(*acts[i], std::move(spans[i]));
  }
}

void DeferredWork::Run() {
  for (size_t first = 0; first < entries_.size(); first += kMaxSessionsPerGroup) {
    const auto part = absl::MakeConstSpan(entries_).subspan(first, kMaxSessionsPerGroup);
    const SessionLocks locks(part);
    absl::InlinedVector<AgentSession*, 1> sessions;
    for (const auto& entry : part) {
      entry->mutex.AssertHeld();
      sessions.push_back(&entry->agent);
    }
    AgentSession::AppendPendingActions(sessions);
    for (const auto& entry : part) {
      entry->mutex.AssertHeld();
      if (entry->shadow_steps == nullptr || entry->shadow_steps->empty()) continue;
      shadows_->Submit(entry->shadow, entry->served->version, entry->shadow_steps->Take());
    }
  }
  entries_.clear();
}

}  // namespace spikeserve
