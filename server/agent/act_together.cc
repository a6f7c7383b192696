#include "server/agent/act_together.h"

#include <cstdint>
#include <optional>
#include <utility>

#include "absl/container/inlined_vector.h"
#include "core/session/session_locks.h"
#include "server/agent/convert.h"
#include "server/agent/request_order.h"
#include "server/agent/session_gate.h"

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

}  // namespace

void DecideActs(absl::Span<DecisionRequest* const> acts) {
  absl::InlinedVector<std::shared_ptr<SessionEntry>, 1> entries;
  for (const DecisionRequest* act : acts) entries.push_back(act->entry);
  const SessionLocks locks(entries);
  absl::InlinedVector<AgentSession::ActCall, 1> calls;
  for (const DecisionRequest* act : acts) {
    act->entry->mutex.AssertHeld();
    AgentSession& agent = act->entry->agent;
    if (act->entry->journal != nullptr) act->entry->journal->WriteAgainIfMissing(agent.session());
    calls.push_back({.session = &agent,
                     .step = act->is_next ? agent.session().step : act->request->step(),
                     .observation = act->request->observation(),
                     .reward = act->request->reward(),
                     .decision = Decision(*act),
                     .executed = ExecutedAction(*act->request)});
  }
  AgentSession::ActTogether(absl::MakeSpan(calls));
  for (size_t i = 0; i < acts.size(); ++i) {
    DecisionRequest& act = *acts[i];
    SessionEntry& entry = *act.entry;
    entry.mutex.AssertHeld();
    act.status = calls[i].answer.status();
    const Session& session = entry.agent.session();
    const Place place = PlaceOf(*act.request);
    if (absl::IsFailedPrecondition(act.status)) {
      act.status = SessionGate::Refused(*act.context, place, act.status, entry);
      if (absl::IsNotFound(act.status)) continue;
    }
    AddCommits(act, place, /*has_decided=*/act.status.ok() && !calls[i].is_retry);
    if (!act.status.ok()) {
      entry.served->observer->OnError();
      continue;
    }
    if (entry.shadow != nullptr && !calls[i].is_retry) {
      entry.shadow_steps.push_back(MakeShadowStep(*act.request, session));
    }
    ToProto(act.request->session_id(), **calls[i].answer, entry.served->policy(), act.response);
    if (const SessionJournal* journal = entry.journal.get(); journal != nullptr) {
      act.response->set_durable_decision(journal->is_sync() ? session.decisions
                                                            : journal->durable_decisions());
    }
  }
}

}  // namespace spikeserve
