#include "server/agent/session_gate.h"

#include <atomic>
#include <cstddef>
#include <functional>
#include <utility>

#include "core/agent/repeated_step.h"
#include "core/session/session_id.h"
#include "server/base/expected_decision.h"

namespace spikeserve {
namespace {

// Gathers the outcomes of what one answer waits for.
struct Gathering {
  std::atomic<size_t> missing;
  std::vector<absl::Status> outcomes;
  std::function<void(const std::vector<absl::Status>&)> done;
};

// The spans of what one commit waits for. Not thread-safe: one outcome follows the other.
struct WaitSpans {
  WaitSpans(const Span& call, const Commit& commit)
      : append(call.Store("append")),
        merge(commit.contribution == nullptr ? Span() : call.Store("merge")) {}

  void OnStored() {
    append.End();
    merge.Restart();
  }
  void OnEnd(const absl::Status& status) {
    if (append) {
      merge = Span();  // nothing was merged
      append.Fail(status);
      return append.End();
    }
    merge.Fail(status);
    merge.End();
  }

  Span append;
  Span merge;
};

// Calls `done` once, on any thread, with the outcome of each of `commits`; see
// SessionJournal::WhenDurable() and FleetContribution::WhenMerged().
// `call` is traced while it waits.
void WhenDurable(const Span& call, const Commits& commits,
                 std::function<void(const std::vector<absl::Status>& outcomes)> done) {
  const auto gathering = std::make_shared<Gathering>();
  gathering->missing = commits.size();
  gathering->outcomes.resize(commits.size());
  gathering->done = std::move(done);
  for (size_t i = 0; i < commits.size(); ++i) {
    const auto spans = call ? std::make_shared<WaitSpans>(call, commits[i]) : nullptr;
    const auto finish = [gathering, i, spans](const absl::Status& status) {
      if (spans != nullptr) spans->OnEnd(status);
      gathering->outcomes[i] = status;
      if (gathering->missing.fetch_sub(1) == 1) gathering->done(gathering->outcomes);
    };
    commits[i].journal->WhenDurable(
        commits[i].position,
        [finish, spans, contribution = commits[i].contribution](const absl::Status& status) {
          if (!status.ok() || contribution == nullptr) return finish(status);
          if (spans != nullptr) spans->OnStored();
          contribution->WhenMerged(finish);
        });
  }
}

// Ends the span of a search. A session that the store does not have either is no failure of it.
void EndSpan(const absl::Status& status, Span* span) {
  const bool found = !absl::IsNotFound(status);
  span->Set("spikeserve.found", static_cast<int64_t>(found));
  if (found) span->Fail(status);
  span->End();
}

// Returns whether a request at `place` follows something that this copy of the session has not
// seen: a decision, or the end of an episode. Only another server can have answered that. Orders by
// episode, decision and step. The end of an episode changes no number of decisions, but the step
// after it is a smaller one.
bool IsAhead(const Place& place, const Session& session) {
  const int64_t step = place.step.value_or(0);
  if (place.episode.has_value() && *place.episode != session.episode) {
    return *place.episode > session.episode;
  }
  if (!place.decision.has_value()) return step > session.step;
  if (*place.decision != session.decisions) return *place.decision > session.decisions;
  return step < session.step;
}

}  // namespace

void AddCommit(const SessionEntry& entry, Await await, Commits* commits) {
  if (entry.journal == nullptr) return;
  SessionJournal& journal = *entry.journal;
  const auto& last = entry.agent.session().last_answer;
  const bool of_operator = last.has_value() && last->source.kind == SourceKind::kOperator;
  const bool asks_whose = await >= Await::kOwned && journal.is_shared();
  if (asks_whose && await == Await::kConfirmed) journal.OnConfirm();
  if (asks_whose || await == Await::kStored || journal.is_sync() || of_operator) {
    commits->push_back({entry.journal, journal.written()});
  }
}

absl::Status CheckMayBeHeard(const SessionEntry& entry) {
  if (entry.journal == nullptr) return absl::OkStatus();
  const bool is_heard = entry.agent.seat() != nullptr && entry.agent.hold() == nullptr;
  return is_heard ? entry.journal->CheckReachable() : absl::OkStatus();
}

struct SessionGate::Search {
  std::shared_ptr<GatedRequest> request;
  absl::Status status;  // of the request, which has found no session
  size_t missing;       // sessions that are being looked for
  Span span = {};       // of the search
  std::map<std::string, absl::Status> unclaimed = {};
};

absl::StatusOr<std::shared_ptr<SessionEntry>> SessionGate::Find(const CallContext& context,
                                                                const std::string& id) const {
  return store_.Find(id, context.caller->tenant()->name());
}

// Only gRPC takes sessions over, and then brings the key of the new owner for datagrams.
void SessionGate::Enter(CallContext* context) const {
  context->may_claim = recovery_ != nullptr && !context->is_datagram;
}

absl::Status SessionGate::Refused(const CallContext& context, const Place& place,
                                  const absl::Status& refusal, SessionEntry& entry) {
  const Session& session = entry.agent.session();
  SessionJournal* const journal = entry.journal.get();
  // A request that does not name its place in the session may be right for a newer copy, whatever
  // its step is.
  const bool may_be_outdated = context.may_claim && journal != nullptr && journal->is_shared() &&
                               (IsAhead(place, session) || !place.is_of_session());
  if (may_be_outdated) {
    journal->Abandon();
    return NoSuchSession(session.id);
  }
  absl::Status status = refusal;
  if (TakeConflict(&status)) {
    entry.served->observer->OnConflict();
    return status;
  }
  return WithExpectedDecision(
      status, {.decision = session.decisions, .episode = session.episode, .step = session.step});
}

void SessionGate::Claim(const CallContext& context, const std::string& id,
                        const SessionRecovery::Post& post, SessionRecovery::Done done) const {
  const auto span = std::make_shared<Span>(context.span.Store("claim"));
  span->Set("spikeserve.session.id", id);
  recovery_->Recover(*context.caller, id, post,
                     [span, done = std::move(done)](const absl::Status& claimed) {
                       EndSpan(claimed, span.get());
                       done(claimed);
                     });
}

void SessionGate::AwaitEarlier(const std::string& id, CallContext* context) const {
  const std::string& tenant = context->caller->tenant()->name();
  const auto entry = store_.Peek(id, tenant);
  if (entry == nullptr || entry->tenant != tenant) return;
  absl::MutexLock lock(&entry->mutex);
  AddCommit(*entry, Await::kDurable, &context->commits);
}

absl::Status SessionGate::MovedError() {
  return absl::UnavailableError(
      "session_id: expected a session of this server, received one that is being taken over; try "
      "again");
}

void SessionGate::Leave(GatedRequest& request, const absl::Status& status) const {
  if (request.call_context().may_claim && FindMissing(request, status)) return;
  if (request.call_context().has_claimed && absl::IsNotFound(status)) {
    return request.Answer(MovedError());
  }
  if (request.call_context().commits.empty() || request.is_over()) return request.Answer(status);
  if (status.ok()) request.OnGranted();
  Await(request, status);
}

void SessionGate::Trace(const Span& call, const SessionEntry& entry,
                        const std::shared_ptr<FleetContribution>& contribution) {
  if (!call || entry.journal == nullptr) return;
  const Commit commit = {
      .journal = entry.journal, .position = entry.journal->written(), .contribution = contribution};
  WhenDurable(call, {commit}, [](const std::vector<absl::Status>& /*outcomes*/) {});
}

Span SessionGate::StartMerge(const Span& call, const SessionEntry& entry) {
  const auto& learning = entry.agent.session().options.learning;
  const bool merges = learning.has_value() && learning->scope == Scope::kFleet;
  return merges && entry.journal == nullptr ? call.Child("merge") : Span();
}

bool SessionGate::FindMissing(GatedRequest& request, const absl::Status& status) const {
  if (request.is_over()) return false;
  const std::vector<std::string> missing = request.MissingSessions(status);
  if (missing.empty()) return false;
  CallContext& context = request.call_context();
  context.may_claim = false;
  const SessionRecovery::Post post = request.post();
  const auto search = std::make_shared<Search>(Search{.request = request.Self(),
                                                      .status = status,
                                                      .missing = missing.size(),
                                                      .span = context.span.Store("claim")});
  search->span.Set("spikeserve.session.id", missing[0]);
  if (request.only_reads() && recovery_->is_shared()) {
    recovery_->Read(*context.caller, missing[0], post,
                    [search](auto session) { OnRead(*search, std::move(session)); });
    return true;
  }
  for (const std::string& id : missing) {
    recovery_->Recover(*context.caller, id, post, [search, id](const absl::Status& claimed) {
      OnFound(*search, id, claimed);
    });
  }
  return true;
}

void SessionGate::OnRead(Search& search, absl::StatusOr<std::shared_ptr<SessionEntry>> session) {
  GatedRequest& request = *search.request;
  EndSpan(session.status(), &search.span);
  if (request.is_over() || absl::IsNotFound(session.status())) return request.Answer(search.status);
  if (!session.ok()) return request.Answer(session.status());
  request.call_context().read = *std::move(session);
  request.HandleAgain({});
}

void SessionGate::OnFound(Search& search, const std::string& id, const absl::Status& claimed) {
  const bool failed = !claimed.ok() && !absl::IsNotFound(claimed);
  if (!claimed.ok()) search.unclaimed.emplace(id, claimed);
  if (--search.missing > 0) return;
  EndSpan(claimed, &search.span);
  GatedRequest& request = *search.request;
  if (request.is_over()) return request.Answer(search.status);
  if (!claimed.ok() && !request.has_items()) {
    return request.Answer(failed ? claimed : search.status);
  }
  if (!request.has_items()) request.call_context().commits.clear();
  request.call_context().has_claimed = true;
  request.HandleAgain(search.unclaimed);
}

void SessionGate::Await(GatedRequest& request, const absl::Status& status) const {
  // The request is moved on, because it must be destroyed on the thread of its loop.
  WhenDurable(request.call_context().span, request.call_context().commits,
              [this, self = request.Self(), post = request.post(),
               status](const std::vector<absl::Status>& outcomes) mutable {
                post([this, self = std::move(self), status, outcomes] {
                  OnDurable(*self, status, outcomes);
                });
              });
}

bool SessionGate::Withdraw(SessionJournal& journal) const {
  if (!journal.Withdraw()) return false;
  store_.Find(journal.key().id, journal.key().tenant).IgnoreError();  // removes the lost copy
  return true;
}

void SessionGate::OnDurable(GatedRequest& request, const absl::Status& status,
                            const std::vector<absl::Status>& outcomes) const {
  const Commits commits = std::exchange(request.call_context().commits, {});
  absl::Status ended = status;
  for (size_t i = 0; i < commits.size(); ++i) {
    if (outcomes[i].ok()) {
      if (commits[i].contribution != nullptr) request.TakeMerged(*commits[i].contribution);
    } else if (commits[i].opens && !Withdraw(*commits[i].journal)) {
      continue;  // the store has taken it since
    } else if (commits[i].item >= 0) {
      request.FailItem(commits[i].item, outcomes[i]);
    } else if (status.ok() || commits[i].journal->lost()) {
      ended = outcomes[i];  // the copy of another server may not refuse the request
    }
  }
  Leave(request, ended);
}

}  // namespace spikeserve
