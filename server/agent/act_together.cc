#include "server/agent/act_together.h"

#include <optional>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/container/inlined_vector.h"
#include "core/session/session_locks.h"
#include "server/agent/beat_requests.h"
#include "server/agent/convert.h"
#include "server/agent/request_order.h"
#include "server/base/expected_decision.h"

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

// Returns whether the session is to be claimed again, because this copy of it may be an old one. A
// request that does not name its decision may be right for a newer one, whatever its step is.
bool MayBeOutdated(const ActItem& item, const Session& session) {
  if (!item.may_claim || item.entry->journal == nullptr) return false;
  return IsAhead(*item.request, session) ||
         (!NamesPlace(*item.request) && item.entry->journal->is_shared());
}

// Returns the number of the decision that the request names, if it names one.
std::optional<uint64_t> Decision(const ActItem& item) {
  if (!item.step.has_value() || !item.request->has_decision()) return std::nullopt;
  return item.request->decision();
}

// Takes the beats of a request. Returns whether the decision is to be made now.
bool TakeBeatsOf(ActItem& item, const Clock& clock, int64_t* budget)
    ABSL_EXCLUSIVE_LOCKS_REQUIRED(item.entry->mutex) {
  SessionEntry& entry = *item.entry;
  const bool is_new = entry.journal == nullptr || entry.journal->is_new();
  const auto on_appended = [&](const Beat& beat) {
    entry.mutex.AssertHeld();
    if (entry.shadow == nullptr) return;
    entry.shadow_steps.push_back(
        MakeShadowStep(beat.observation, beat.reward, /*reports=*/true, entry.agent.session()));
  };
  const auto decides =
      TakeBeats(*item.request, item.received, clock, *entry.served->observer, is_new, &entry.agent,
                &entry.robot, budget, &item.beats, on_appended);
  item.status = decides.status();
  return decides.ok() && *decides;
}

// Sets what follows from `item.status`. `is_new` is true if the session has changed.
void Conclude(ActItem& item, bool is_new) ABSL_EXCLUSIVE_LOCKS_REQUIRED(item.entry->mutex) {
  const Session& session = item.entry->agent.session();
  if (absl::IsFailedPrecondition(item.status)) {
    item.status = WithExpectedDecision(item.status, session.decisions, session.step);
    if (MayBeOutdated(item, session)) {
      item.entry->journal->Abandon();
      item.status = NoSuchSession(item.request->session_id());
      return;
    }
  }
  // Errors wait, too, so that the answers of one session keep their order.
  if (NamesPlace(*item.request)) {
    AddCommit(*item.entry, &item.commits);
  } else {
    AddConfirmation(*item.entry, item.status.ok() && is_new, &item.commits);
  }
  if (!item.status.ok()) return item.entry->served->observer->OnError();
  if (const SessionJournal* journal = item.entry->journal.get(); journal != nullptr) {
    item.response->set_durable_decision(journal->is_sync() ? session.decisions
                                                           : journal->durable_decisions());
  }
}

}  // namespace

void ActTogether(absl::Span<ActItem> items, const Clock& clock) {
  absl::InlinedVector<std::shared_ptr<SessionEntry>, 1> entries;
  for (const ActItem& item : items) entries.push_back(item.entry);
  const SessionLocks locks(entries);
  absl::InlinedVector<AgentSession::ActCall, 1> calls;
  absl::InlinedVector<ActItem*, 1> deciding;  // the items of `calls`
  int64_t budget = kBeatsPerGroup;
  absl::Duration begun;  // of the decisions
  for (ActItem& item : items) {
    item.entry->mutex.AssertHeld();
    AgentSession& agent = item.entry->agent;
    if (item.entry->journal != nullptr) item.entry->journal->WriteAgainIfMissing(agent.session());
    if (HasBeats(*item.request)) {
      const bool decides = TakeBeatsOf(item, clock, &budget);
      if (!item.beats.finished && item.status.ok()) continue;
      begun = clock.Now();
      if (!decides) {
        Conclude(item, /*is_new=*/item.beats.appended > 0);
        if (item.status.ok()) {
          FillBeats(*item.request, item.beats, agent.session(), item.received, begun,
                    item.response);
        }
        continue;
      }
    }
    calls.push_back({.session = &agent,
                     .step = item.step.value_or(agent.session().step),
                     .observation = item.request->observation(),
                     .reward = item.request->reward(),
                     .decision = Decision(item),
                     .executed = ExecutedBefore(*item.request)});
    deciding.push_back(&item);
  }
  AgentSession::ActTogether(absl::MakeSpan(calls));
  for (size_t i = 0; i < calls.size(); ++i) {
    ActItem& item = *deciding[i];
    item.entry->mutex.AssertHeld();
    item.status = calls[i].answer.status();
    Conclude(item, !calls[i].is_retry);
    if (!item.status.ok()) continue;
    const Session& session = item.entry->agent.session();
    if (calls[i].is_retry) item.entry->served->observer->OnRepeated();
    if (item.entry->shadow != nullptr && !calls[i].is_retry) {
      item.entry->shadow_steps.push_back(MakeShadowStep(item.request->observation(),
                                                        item.request->reward(),
                                                        calls[i].executed.has_value(), session));
    }
    ToProto(item.request->session_id(), **calls[i].answer, item.entry->served->policy(),
            item.response);
    if (HasBeats(*item.request)) {
      FillBeats(*item.request, item.beats, session, item.received, begun, item.response);
    }
  }
}

}  // namespace spikeserve
