#include "server/agent/act_together.h"

#include <optional>
#include <utility>

#include "absl/container/inlined_vector.h"
#include "core/session/session_locks.h"
#include "server/agent/convert.h"
#include "server/agent/request_order.h"
#include "server/base/expected_decision.h"

namespace spikeserve {
namespace {

std::optional<ReportedAction> ExecutedAction(const v1::ActRequest& request) {
  if (!request.has_executed_action()) return std::nullopt;
  return FromProto(request.executed_action());
}

// Returns the step that the session's shadow will replay for the decision that was just made.
ShadowStep MakeShadowStep(const v1::ActRequest& request, const Session& session) {
  std::optional<Action> executed;
  if (request.has_executed_action() && session.last_answer->step > 0) {
    executed = session.history.action(session.history.size() - 2);
  }
  return {.episode = session.episode,
          .step = session.last_answer->step,
          .observation = {request.observation().begin(), request.observation().end()},
          .reward = request.reward(),
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

}  // namespace

void ActTogether(absl::Span<ActItem> items) {
  absl::InlinedVector<std::shared_ptr<SessionEntry>, 1> entries;
  for (const ActItem& item : items) entries.push_back(item.entry);
  const SessionLocks locks(entries);
  absl::InlinedVector<AgentSession::ActCall, 1> calls;
  for (const ActItem& item : items) {
    item.entry->mutex.AssertHeld();
    AgentSession& agent = item.entry->agent;
    if (item.entry->journal != nullptr) item.entry->journal->WriteAgainIfMissing(agent.session());
    calls.push_back({.session = &agent,
                     .step = item.step.value_or(agent.session().step),
                     .observation = item.request->observation(),
                     .reward = item.request->reward(),
                     .decision = Decision(item),
                     .executed = ExecutedAction(*item.request)});
  }
  AgentSession::ActTogether(absl::MakeSpan(calls));
  for (size_t i = 0; i < items.size(); ++i) {
    ActItem& item = items[i];
    item.entry->mutex.AssertHeld();
    item.status = calls[i].answer.status();
    const Session& session = item.entry->agent.session();
    if (absl::IsFailedPrecondition(item.status)) {
      item.status = WithExpectedDecision(item.status, session.decisions, session.step);
      if (MayBeOutdated(item, session)) {
        item.entry->journal->Abandon();
        item.status = NoSuchSession(item.request->session_id());
        continue;
      }
    }
    // Errors wait, too, so that the answers of one session keep their order.
    if (NamesPlace(*item.request)) {
      AddCommit(*item.entry, &item.commits);
    } else {
      AddConfirmation(*item.entry, item.status.ok() && !calls[i].is_retry, &item.commits);
    }
    if (!item.status.ok()) {
      item.entry->served->observer->OnError();
      continue;
    }
    if (item.entry->shadow != nullptr && !calls[i].is_retry) {
      item.entry->shadow_steps.push_back(MakeShadowStep(*item.request, session));
    }
    ToProto(item.request->session_id(), **calls[i].answer, item.entry->served->policy(),
            item.response);
    if (const SessionJournal* journal = item.entry->journal.get(); journal != nullptr) {
      item.response->set_durable_decision(journal->is_sync() ? session.decisions
                                                             : journal->durable_decisions());
    }
  }
}

}  // namespace spikeserve
