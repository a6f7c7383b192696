#include "server/agent/policy_handler.h"

#include <algorithm>
#include <utility>
#include <vector>

#include "absl/algorithm/container.h"
#include "absl/container/inlined_vector.h"
#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/journal/session_export.h"
#include "core/session/session_id.h"
#include "server/agent/session_recovery.h"
#include "server/base/retry_delay.h"
#include "server/messages/convert.h"
#include "server/messages/explain_convert.h"
#include "server/messages/step_convert.h"

namespace spikeserve {
namespace {

// Callers wait this long when a session has to wait for the store.
constexpr absl::Duration kStoreRetryDelay = absl::Seconds(1);

// So many rewards of skipped steps take about as long as a decision.
constexpr int64_t kSkippedPerDecision = 128;

// What the beats of one turn take, beyond the one that crosses it: a few decisions.
constexpr absl::Duration kBeatTime = absl::Microseconds(200);

// Returns how many decisions the beats of a request count as.
int64_t BeatsOf(const DecisionRequest& act) {
  return act.step.result.appended + act.step.result.dropped / kSkippedPerDecision;
}

}  // namespace

absl::Status PolicyHandler::CheckMayPlay(const Credential& caller, SessionEntry& entry) {
  if (caller.may_learn()) return absl::OkStatus();
  absl::MutexLock lock(&entry.mutex);
  if (!entry.agent.session().options.learning.has_value()) return absl::OkStatus();
  return absl::PermissionDeniedError(
      "session_id: expected a session that does not learn, because the token has \"learning\": "
      "false, received one that does");
}

absl::Status PolicyHandler::ListPolicies(CallContext& /*context*/,
                                         const v1::ListPoliciesRequest& /*request*/,
                                         v1::ListPoliciesResponse* response) const {
  const std::shared_ptr<const PolicyCatalog> catalog = registry_->catalog();
  absl::MutexLock lock(&list_mutex_);
  if (listed_.lock() != catalog) {
    list_.Clear();
    for (const auto& [name, policy] : catalog->policies()) {
      for (const auto& [version, served] : policy.versions) {
        *list_.add_policies() = ToProto(policy, *served);
      }
    }
    listed_ = catalog;
  }
  *response = list_;
  return absl::OkStatus();
}

absl::StatusOr<std::shared_ptr<SessionEntry>> PolicyHandler::FindForDecision(
    CallContext& context, const v1::ActRequest& request) const {
  const Credential& caller = *context.caller;
  if (!std::exchange(context.has_paid, false)) {
    RETURN_IF_ERROR(caller.tenant()->AcquireDecision(clock_->Now()));
  }
  auto entry = gate_->Find(context, request.session_id());
  if (!entry.ok()) return entry;
  RETURN_IF_ERROR(CheckMayPlay(caller, **entry));
  if ((*entry)->journal == nullptr) return entry;
  const absl::Status writable = (*entry)->journal->CheckWritable();
  if (writable.ok()) return entry;
  return RetryDelay(writable).has_value() ? writable : WithRetryDelay(writable, kStoreRetryDelay);
}

StepBudget PolicyHandler::NewBudget() const { return {.until = clock_->Now() + kBeatTime}; }

void PolicyHandler::CountBeats(const Credential& caller, int64_t beats) const {
  if (!caller.tenant()->limits_decisions()) return;
  const absl::Duration now = clock_->Now();
  for (; beats > 0 && caller.tenant()->AcquireDecision(now).ok(); --beats) {
  }
}

absl::Status PolicyHandler::Act(CallContext& context, const v1::ActRequest& request,
                                v1::ActResponse* response, bool is_next) const {
  ASSIGN_OR_RETURN(auto entry, FindForDecision(context, request));
  DecisionRequest act = {.context = &context,
                         .request = &request,
                         .response = response,
                         .is_next = is_next,
                         .entry = std::move(entry),
                         .received = clock_->Now()};
  DecideActs({&act}, registry_->settings().holds(), /*budget=*/nullptr);
  if (act.status.ok()) context.deferred->Add(std::move(act.entry), shadows_);
  return act.status;
}

size_t PolicyHandler::ActGroup(absl::Span<DecisionRequest* const> acts, DeferredWork* deferred,
                               StepBudget* budget) const {
  absl::InlinedVector<DecisionRequest*, 1> found;  // without requests that were refused
  absl::InlinedVector<int64_t, 1> appended;        // by these, before
  const size_t most = std::min(acts.size(), kMaxSessionsPerGroup);
  size_t size = 0;
  for (; size < most; ++size) {
    DecisionRequest& act = *acts[size];
    const std::string& id = act.request->session_id();
    const auto is_of_session = [&](const DecisionRequest* other) {
      return other->request->session_id() == id;
    };
    // So that the decisions of one session are made in order.
    if (absl::c_any_of(acts.first(size), is_of_session)) break;
    act.status = absl::OkStatus();
    act.Become(DecisionState::kWaiting);
    // Handled again, with more of its history or after its session was taken over.
    if (act.has_paid) act.context->has_paid = true;
    act.has_paid = true;
    auto entry = FindForDecision(*act.context, *act.request);
    act.status = entry.status();
    if (!entry.ok()) {
      act.Conclude();
      if (act.item < 0 && act.is_decided()) gate_->AwaitEarlier(id, act.context);
      continue;
    }
    act.entry = *std::move(entry);
    act.policy = act.entry->served->name;
    found.push_back(&act);
    appended.push_back(BeatsOf(act));
  }
  DecideActs(found, registry_->settings().holds(), budget);
  for (size_t i = 0; i < found.size(); ++i) {
    DecisionRequest& act = *found[i];
    auto entry = std::exchange(act.entry, nullptr);
    act.Conclude();
    if (act.status.ok() && datagrams_ != nullptr) {
      datagrams_->Renew(entry, *act.context, act.response);
    }
    const int64_t beats = BeatsOf(act) - appended[i];
    if (beats > 0) CountBeats(*act.context->caller, beats);
    if (act.status.ok()) deferred->Add(std::move(entry), shadows_);
  }
  return size;
}

absl::Status PolicyHandler::CheckBatch(const v1::ActBatchRequest& request) {
  if (request.requests_size() <= kMaxBatch) return absl::OkStatus();
  return InvalidArgument("requests", absl::StrCat("at most ", kMaxBatch), request.requests_size());
}

int PolicyHandler::ActBatchGroup(CallContext& context, const v1::ActBatchRequest& request,
                                 int first, v1::ActBatchResponse* response, absl::Duration received,
                                 StepOutcome* progress, StepBudget* budget) const {
  SPIKESERVE_DCHECK(CheckBatch(request).ok());
  SPIKESERVE_DCHECK(first >= 0 && first <= request.requests_size());
  while (response->results_size() < request.requests_size()) response->add_results();
  const int limit =
      std::min(request.requests_size(), first + static_cast<int>(kMaxSessionsPerGroup));
  int end = std::min(first + 1, limit);
  if (end < limit && !HasPastBeats(request.requests(first))) {
    while (end < limit && !HasPastBeats(request.requests(end))) ++end;
  }
  absl::InlinedVector<DecisionRequest, kMaxSessionsPerGroup> items;
  absl::InlinedVector<DecisionRequest*, kMaxSessionsPerGroup> acts;
  for (int i = first; i < end; ++i) {
    v1::ActResult& result = *response->mutable_results(i);
    if (result.has_response() || result.code() != 0) continue;
    items.push_back({.context = &context,
                     .request = &request.requests(i),
                     .response = result.mutable_response(),
                     .item = i,
                     .has_paid = progress->started || context.has_claimed,
                     .received = received,
                     .step = {.result = std::exchange(*progress, {})}});
  }
  for (DecisionRequest& item : items) acts.push_back(&item);
  for (absl::Span<DecisionRequest* const> rest = acts; !rest.empty();) {
    StepBudget of_group;
    rest.remove_prefix(ActGroup(rest, context.deferred, budget == nullptr ? &of_group : budget));
  }
  for (const DecisionRequest& item : items) {
    if (!item.is_decided()) {
      response->mutable_results(item.item)->Clear();
      *progress = item.step.result;
      return first;
    }
    if (!item.status.ok()) ErrorToProto(item.status, response->mutable_results(item.item));
  }
  return end;
}

absl::Status PolicyHandler::EndEpisode(CallContext& context, const v1::EndEpisodeRequest& request,
                                       v1::EndEpisodeResponse* response) const {
  ASSIGN_OR_RETURN(const auto entry, gate_->Find(context, request.session_id()));
  RETURN_IF_ERROR(CheckMayPlay(*context.caller, *entry));
  absl::MutexLock lock(&entry->mutex);
  if (entry->journal != nullptr) entry->journal->WriteAgainIfMissing(entry->agent.session());
  Step step;
  ToStep(request, *entry, &step);
  Span merge = SessionGate::StartMerge(context.span, *entry);
  AgentSession::Apply({&step});
  const absl::Status& status = step.result.status;
  merge.Fail(status);
  merge.End();
  if (absl::IsFailedPrecondition(status)) {
    return SessionGate::Refused(context, step.place, status, *entry);
  }
  if (!status.ok()) return status;
  AddCommit(*entry, AwaitAt(step.place, !step.result.is_retry), &context.commits);
  if (context.commits.empty()) {
    SessionGate::Trace(context.span, *entry, entry->agent.contribution());
  } else {
    context.commits.back().contribution = entry->agent.contribution();
  }
  ToProto(step, *entry, response);
  return absl::OkStatus();
}

absl::StatusOr<std::shared_ptr<SessionEntry>> PolicyHandler::FindReadable(
    const CallContext& context, const std::string& id) const {
  if (context.read != nullptr) return context.read;
  auto entry = store_->Peek(id, context.caller->tenant()->name());
  if (entry != nullptr && context.caller->CanRead(entry->tenant)) return entry;
  return NoSuchSession(id);
}

absl::Status PolicyHandler::GetSession(CallContext& context, const v1::GetSessionRequest& request,
                                       v1::GetSessionResponse* response) const {
  ASSIGN_OR_RETURN(const auto entry, FindReadable(context, request.session_id()));
  absl::MutexLock lock(&entry->mutex);
  *response = ToProto(entry->agent, request.include_head_delta());
  return absl::OkStatus();
}

absl::Status PolicyHandler::Explain(CallContext& context, const v1::ExplainRequest& request,
                                    v1::ExplainResponse* response) const {
  ASSIGN_OR_RETURN(const auto entry, FindReadable(context, request.session_id()));
  return ExplainSession(*entry, response);
}

absl::Status PolicyHandler::ExportSession(CallContext& context,
                                          const v1::ExportSessionRequest& request,
                                          v1::ExportSessionResponse* response) const {
  absl::StatusOr<std::shared_ptr<SessionEntry>> entry = context.read;
  if (*entry == nullptr) entry = gate_->Find(context, request.session_id());
  if (!entry.ok()) return entry.status();
  RETURN_IF_ERROR(CheckMayPlay(*context.caller, **entry));
  const ServedPolicy& served = *(*entry)->served;
  if (request.include_policy()) {
    auto files = registry_->folder().ReadForRobot({served.name, served.version});
    if (files.ok()) response->set_policy_file(std::move(files->policy));
  }
  response->set_policy(served.name);
  response->set_version(served.version);
  SessionEntry& exported = **entry;
  absl::MutexLock lock(&exported.mutex);
  const Session& session = exported.agent.session();
  response->set_value(spikeserve::ExportSession(exported.agent));
  response->set_policy_sha256(session.options.policy_sha256);
  response->set_decision(session.decisions);
  response->set_episode(session.episode);
  response->set_step(session.step);
  response->set_frozen(IsFrozenByExport(session));
  return absl::OkStatus();
}

absl::Status PolicyHandler::CloseSession(CallContext& context,
                                         const v1::CloseSessionRequest& request,
                                         v1::CloseSessionResponse* /*response*/) const {
  ASSIGN_OR_RETURN(const auto entry, gate_->Find(context, request.session_id()));
  const auto status = store_->Close(request.session_id(), context.caller->tenant()->name());
  if (!status.ok() || entry->journal == nullptr) return status;
  // The store refuses the end if another server has taken the session over. ASYNC sessions wait for
  // this, too, unless the store cannot be reached: then the end is written when it comes back.
  SessionJournal& journal = *entry->journal;
  if (journal.is_sync() || durability_.journals->CheckReachable().ok()) {
    context.commits.push_back({.journal = entry->journal, .position = journal.written()});
  }
  return status;
}

}  // namespace spikeserve
