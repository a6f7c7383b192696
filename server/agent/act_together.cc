#include "server/agent/act_together.h"

#include <optional>
#include <utility>

#include "absl/container/inlined_vector.h"
#include "core/session/session_locks.h"
#include "server/agent/convert.h"
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

bool IsAhead(const v1::ActRequest& request, const Session& session) {
  return request.has_decision() ? request.decision() > session.decisions
                                : request.step() > session.step;
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
    // Errors wait, too, so that the answers of one session keep their order.
    AddCommit(*item.entry, &item.commits);
    const Session& session = item.entry->agent.session();
    if (absl::IsFailedPrecondition(item.status)) {
      item.status = WithExpectedDecision(item.status, session.decisions, session.step);
      if (item.may_claim && item.entry->journal != nullptr && IsAhead(*item.request, session)) {
        item.entry->journal->Abandon();
        item.status = NoSuchSession(item.request->session_id());
        continue;
      }
    }
    if (!item.status.ok()) {
      item.entry->served->observer->OnError(item.request->session_id());
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
