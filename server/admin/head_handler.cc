#include <cstddef>
#include <cstdint>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/action/step_source.h"
#include "core/agent/head_log.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/learning/frobenius_norm.h"
#include "core/learning/learner.h"
#include "nlohmann/json.hpp"
#include "server/admin/admin_handler.h"
#include "server/admin/traffic.h"
#include "server/agent/session_gate.h"
#include "server/policies/policy_folder.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

constexpr double kShortestUndo = 1.0;  // seconds
constexpr double kLongestUndo = 86400.0;

// The training record that is stored in the file of `policy`, and how often a head of it was
// promoted. The record of a promoted policy is that of the ancestor that was trained, so that
// records do not grow from promotion to promotion.
struct Ancestor {
  Json training;
  int64_t promotions = 0;
};

Ancestor TrainedAncestor(const Policy& policy) {
  Ancestor ancestor = {.training = Json::parse(policy.training)};
  while (ancestor.training.is_object() && ancestor.training.contains("promoted")) {
    const Json counted = ancestor.training["promoted"].is_object()
                             ? ancestor.training["promoted"].value("promotions", Json())
                             : Json();
    ancestor.promotions += counted.is_number_integer() ? counted.get<int64_t>() : 1;
    Json parent = ancestor.training.value("parent_training", Json());
    ancestor.training = std::move(parent);
  }
  return ancestor;
}

// Returns the policy with the shared head as its action head. Its training record holds the lineage
// of the head and, as `parent_training`, the record of the ancestor that was trained, whose
// evaluation does not apply to the new head.
Policy Promoted(const ServedPolicy& served, const FleetHead::Snapshot& snapshot) {
  Policy policy = served.engine->CompletePolicy();
  policy.weights.head = snapshot.head;
  Ancestor ancestor = TrainedAncestor(served.policy());
  const Json lineage = {{"parent_version", served.version},
                        {"promotions", ancestor.promotions + 1},
                        {"updates", snapshot.updates},
                        {"base_norm", BaseNorm(served.policy())},
                        {"delta_norm", FrobeniusNorm(snapshot.delta)},
                        {"drift", snapshot.drift},
                        {"watched_return", snapshot.level.mean}};
  policy.training =
      Json{{"promoted", lineage}, {"parent_training", std::move(ancestor.training)}}.dump();
  return policy;
}

// Returns the head of a tenant. Before the tenant has learned, this is a head like that of the
// policy, which no session learns.
std::shared_ptr<FleetHead> HeadOf(const ServedPolicy& served, const std::string& tenant) {
  if (auto head = served.FindHead(tenant); head != nullptr) return head;
  return std::make_shared<FleetHead>(
      std::shared_ptr<const Policy>(served.engine, &served.policy()));
}

// Brings the heads of a version up to date with their log, if they have one.
absl::Status CatchUp(const ServedPolicy& served) {
  return served.log == nullptr ? absl::OkStatus() : served.log->CatchUp();
}

absl::Status CheckUndo(const v1::UndoCorrectionsRequest& request) {
  const bool names_head =
      !request.policy().empty() || request.version() != 0 || !request.tenant().empty();
  if (names_head == !request.session_id().empty()) {
    return absl::InvalidArgumentError(
        absl::StrCat("session_id: expected either a session or the policy of a shared head, "
                     "received ",
                     names_head ? "both" : "neither"));
  }
  const size_t length = request.operator_id().size();
  if (length < 1 || length > kLongestOperatorId) {
    return InvalidArgument("operator_id", absl::StrCat("1 to ", kLongestOperatorId, " bytes"),
                           length);
  }
  if (!(request.seconds() >= kShortestUndo && request.seconds() <= kLongestUndo)) {
    return InvalidArgument("seconds", absl::StrCat(kShortestUndo, " to ", kLongestUndo),
                           request.seconds());
  }
  return absl::OkStatus();
}

absl::Status ForgottenCorrections(const v1::UndoCorrectionsRequest& request) {
  return absl::FailedPreconditionError(
      absl::StrCat("seconds: expected a time since which the head has every correction by itself, "
                   "received ",
                   request.seconds()));
}

}  // namespace

absl::Status AdminHandler::GetHead(CallContext& context, const v1::GetHeadRequest& request,
                                   v1::GetHeadResponse* response) const {
  ASSIGN_OR_RETURN(const auto served,
                   parts_.registry->catalog()->Find(request.policy(), request.version()));
  ASSIGN_OR_RETURN(const auto tenant, TenantOf(*context.caller, request.tenant()));
  const Policy& policy = served->policy();
  CatchUp(*served).IgnoreError();
  const auto snapshot = HeadOf(*served, tenant)->Read();
  response->set_policy(served->name);
  response->set_version(served->version);
  response->set_base_norm(BaseNorm(policy));
  response->set_delta_norm(FrobeniusNorm(snapshot->delta));
  response->set_drift(snapshot->drift);
  response->set_updates(snapshot->updates);
  response->set_rejected_updates(snapshot->rejected);
  response->set_rollbacks(snapshot->rollbacks);
  response->set_watched_return(snapshot->level.mean);
  response->set_paused(served->learning->paused());
  const bool shared = served->share_heads || tenant.empty();
  const auto on_it = [&](const SessionEntry& entry) {
    return entry.served == served && (shared || entry.tenant == tenant);
  };
  parts_.store->ForEach(on_it, [&](const ListedSession& session) {
    absl::MutexLock lock(&session.entry->mutex);
    const auto& learning = session.entry->agent.session().options.learning;
    if (learning.has_value() && learning->scope == Scope::kFleet) {
      response->set_sessions(response->sessions() + 1);
    }
  });
  if (!request.include_weights()) return absl::OkStatus();
  const std::vector<float>& base = policy.weights.head.weight.values;
  response->mutable_base()->Add(base.begin(), base.end());
  response->mutable_delta()->Add(snapshot->delta.begin(), snapshot->delta.end());
  return absl::OkStatus();
}

absl::Status AdminHandler::PromoteHead(CallContext& context, const v1::PromoteHeadRequest& request,
                                       v1::PromoteHeadResponse* response) const {
  RETURN_IF_ERROR(parts_.registry->folder().CheckCanSign());
  ASSIGN_OR_RETURN(const auto served,
                   parts_.registry->catalog()->Find(request.policy(), request.version()));
  ASSIGN_OR_RETURN(const auto tenant, TenantOf(*context.caller, request.tenant()));
  RETURN_IF_ERROR(CatchUp(*served));
  const auto snapshot = HeadOf(*served, tenant)->Read();
  if (snapshot->drift == 0.0) {
    return absl::FailedPreconditionError(
        absl::StrCat("version: expected one whose shared head has learned, received ",
                     served->version, ", whose shared head equals that of its file"));
  }
  ASSIGN_OR_RETURN(const auto files,
                   parts_.registry->folder().Format(Promoted(*served, *snapshot)));
  ASSIGN_OR_RETURN(
      const auto version,
      AddVersion(tenant,
                 {.policy = served->name, .files = files, .make_default = request.make_default()},
                 response->mutable_traffic()));
  response->set_version(version.version);
  response->set_path(parts_.registry->folder().PathOf(version));
  return absl::OkStatus();
}

absl::Status AdminHandler::RollbackHead(CallContext& context,
                                        const v1::RollbackHeadRequest& request,
                                        v1::RollbackHeadResponse* response) const {
  ASSIGN_OR_RETURN(const auto served,
                   parts_.registry->catalog()->Find(request.policy(), request.version()));
  ASSIGN_OR_RETURN(const auto tenant, TenantOf(*context.caller, request.tenant()));
  if (served->log == nullptr) {
    response->set_drift(HeadOf(*served, tenant)->Rollback()->drift);
    return absl::OkStatus();
  }
  response->set_shared(true);
  const auto drift = served->log->Rollback(served->HeadName(tenant));
  if (drift.ok()) response->set_drift(*drift);
  return drift.status();
}

absl::Status AdminHandler::UndoCorrections(CallContext& context,
                                           const v1::UndoCorrectionsRequest& request,
                                           v1::UndoCorrectionsResponse* response) const {
  RETURN_IF_ERROR(CheckUndo(request));
  if (!request.session_id().empty()) return UndoOfSession(context, request, response);
  ASSIGN_OR_RETURN(const auto served,
                   parts_.registry->catalog()->Find(request.policy(), request.version()));
  ASSIGN_OR_RETURN(const auto tenant, TenantOf(*context.caller, request.tenant()));
  const absl::Duration ago = absl::Seconds(request.seconds());
  MergeOutcome outcome;
  if (served->log != nullptr) {
    ASSIGN_OR_RETURN(outcome,
                     served->log->Undo(served->HeadName(tenant), request.operator_id(), ago));
  } else {
    outcome =
        HeadOf(*served, tenant)->Undo(request.operator_id(), ago, parts_.store->clock()->Now());
  }
  if (outcome.undone < 0) return ForgottenCorrections(request);
  response->set_updates(outcome.undone);
  response->set_head_drift(outcome.drift);
  return absl::OkStatus();
}

absl::Status AdminHandler::UndoOfSession(CallContext& context,
                                         const v1::UndoCorrectionsRequest& request,
                                         v1::UndoCorrectionsResponse* response) const {
  ASSIGN_OR_RETURN(const auto entry, Find(context, request.session_id()));
  absl::MutexLock lock(&entry->mutex);
  const auto& learning = entry->agent.session().options.learning;
  if (!learning.has_value() || learning->scope != Scope::kSession) {
    return absl::FailedPreconditionError(absl::StrCat(
        "session_id: expected a session that learns a head of its own, received one ",
        learning.has_value() ? "of a fleet, whose head policy names" : "that does not learn"));
  }
  const auto undone =
      entry->agent.UndoCorrections(request.operator_id(), absl::Seconds(request.seconds()));
  if (!undone.has_value()) return ForgottenCorrections(request);
  AddCommit(*entry, *undone > 0 ? Await::kOwned : Await::kConfirmed, &context.commits);
  response->set_updates(*undone);
  response->set_head_drift(entry->agent.HeadDrift());
  return absl::OkStatus();
}

absl::Status AdminHandler::PauseLearning(CallContext& /*context*/,
                                         const v1::PauseLearningRequest& request,
                                         v1::PauseLearningResponse* /*response*/) const {
  return SetPaused(request.policy(), true);
}

absl::Status AdminHandler::ResumeLearning(CallContext& /*context*/,
                                          const v1::ResumeLearningRequest& request,
                                          v1::ResumeLearningResponse* /*response*/) const {
  return SetPaused(request.policy(), false);
}

absl::Status AdminHandler::SetPaused(const std::string& policy, bool paused) const {
  absl::Status status = parts_.registry->SetLearningPaused(policy, paused);
  const auto catalog = parts_.registry->catalog();
  for (const auto& [name, served] : catalog->policies()) {
    if (!policy.empty() && name != policy) continue;
    for (const auto& [version, loaded] : served.versions) {
      if (status.ok() && loaded->log != nullptr) status = loaded->log->SetPaused(paused);
    }
  }
  return status;
}

}  // namespace spikeserve
