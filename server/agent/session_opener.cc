// The methods of PolicyHandler that open sessions.
#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/journal/session_bytes.h"
#include "core/session/session_id.h"
#include "core/session/session_value.h"
#include "server/agent/open_request.h"
#include "server/agent/policy_handler.h"
#include "server/agent/session_recovery.h"
#include "server/messages/convert.h"

namespace spikeserve {

absl::Status PolicyHandler::OpenSession(CallContext& context, const v1::OpenSessionRequest& request,
                                        v1::OpenSessionResponse* response) const {
  const std::string& id = request.session_id();
  if (!id.empty() && !IsDrawnSessionId(id)) {
    return InvalidArgument("session_id", "32 hexadecimal digits in lower case", Quoted(id));
  }
  if (request.has_learning() && !context.caller->may_learn()) {
    return absl::PermissionDeniedError(
        "learning: expected unset, because the token has \"learning\": false, received a config");
  }
  ASSIGN_OR_RETURN(const auto durability, ChooseDurability(*context.caller->tenant(), request));
  const auto open = gate_->Find(context, id);
  RETURN_IF_ERROR(open.ok() ? OpenAgain(context, **open, request, durability, response)
                            : OpenNew(context, id, request, durability, response));
  if (!request.datagrams() || datagrams_ == nullptr) return absl::OkStatus();
  ASSIGN_OR_RETURN(const auto entry, gate_->Find(context, response->session_id()));
  datagrams_->Open(entry, *context.caller, response);
  return absl::OkStatus();
}

absl::Status PolicyHandler::OpenSessionAs(CallContext& context, std::string id,
                                          const v1::OpenSessionRequest& request,
                                          v1::OpenSessionResponse* response) const {
  return OpenNew(context, std::move(id), request, Durability::kNone, response);
}

absl::StatusOr<Durability> PolicyHandler::ChooseDurability(
    const Tenant& tenant, const v1::OpenSessionRequest& request) const {
  const bool stores = durability_.journals != nullptr;
  if (!v1::Durability_IsValid(request.durability())) {
    return InvalidArgument("durability", "DURABILITY_DEFAULT, NONE, ASYNC or SYNC",
                           static_cast<int>(request.durability()));
  }
  if (!stores && (request.durability() == v1::ASYNC || request.durability() == v1::SYNC)) {
    return InvalidArgument("durability", "NONE, because the server runs without --session_store",
                           v1::Durability_Name(request.durability()));
  }
  if (!stores) return Durability::kNone;
  const Durability most = tenant.max_durability();
  const auto check = [&](Durability level, absl::string_view why) -> absl::StatusOr<Durability> {
    if (level <= most) return level;
    return absl::PermissionDeniedError(
        absl::StrCat("durability: expected at most ", v1::Durability_Name(ToProto(most)),
                     ", the max_durability of tenant ", tenant.name(), ", received ",
                     v1::Durability_Name(ToProto(level)), why));
  };
  // What a session of a fleet decides depends on the shared head and could not be computed again.
  if (request.learning().scope() == v1::LearningConfig::FLEET) {
    return check(Durability::kSync, ", which learning.scope FLEET needs");
  }
  switch (request.durability()) {
    case v1::NONE:
      return Durability::kNone;
    case v1::ASYNC:
      return check(Durability::kAsync, "");
    case v1::SYNC:
      return check(Durability::kSync, "");
    default:
      return std::min(most, request.has_learning() ? Durability::kSync : durability_.level);
  }
}

absl::Status PolicyHandler::OpenNew(CallContext& context, std::string session_id,
                                    const v1::OpenSessionRequest& request, Durability durability,
                                    v1::OpenSessionResponse* response) const {
  RETURN_IF_ERROR(context.caller->tenant()->CheckBudgets());
  absl::StatusOr<std::string> id = std::move(session_id);
  if (id->empty()) id = NewSessionId();
  if (!id.ok()) return id.status();
  const std::string& tenant = context.caller->tenant()->name();
  ASSIGN_OR_RETURN(const auto route, ChooseRoute(request, *id, *registry_->catalog()));
  const ServedPolicy& served = *route.served;
  ASSIGN_OR_RETURN(auto options, OptionsOf(request, served));
  options.tenant = tenant;
  options.durability = durability;
  SessionExtras extras;
  extras.id = *id;
  extras.quota = context.caller->tenant();
  extras.assigned = route.by_rollout;
  if (route.shadow != nullptr) {
    extras.shadow = std::make_shared<ShadowSession>(*route.shadow, options, clock_);
  }
  if (request.record()) {
    ASSIGN_OR_RETURN(extras.recorder, NewRecorder(route.served, tenant, &options.recording));
  }
  if (durability != Durability::kNone) {
    RETURN_IF_ERROR(durability_.journals->CheckReachable());
    if (durability_.files != nullptr) {
      RETURN_IF_ERROR(durability_.files->Check(served));
    }
    if (durability == Durability::kSync) {
      if (auto status = durability_.journals->CheckKeepsRecords(); !status.ok()) {
        return Annotate(status, "durability");
      }
    }
    extras.journal = std::make_shared<SessionJournal>(
        SessionJournal::Key{
            .id = *id, .tenant = options.tenant, .policy_file = PolicyFileOf(served)},
        durability, /*decisions=*/0, durability_.journals);
  }
  ToProto(*id, options, served, response);
  const std::shared_ptr<SessionJournal> journal = extras.journal;
  auto status = gate_->store().Open(route.served, std::move(options), std::move(extras)).status();
  // A session that was refused is never written, so that nothing of it can be waited for.
  if (status.ok() && journal != nullptr) {
    context.commits.push_back({.journal = journal, .position = 1, .opens = true});
  }
  return status;
}

absl::StatusOr<SessionOptions> PolicyHandler::OptionsOf(const v1::OpenSessionRequest& request,
                                                        const ServedPolicy& served) const {
  auto options = OptionsFromProto(request, served);
  // Stored, so that a server that takes the session over offers a channel, too.
  if (options.ok() && request.datagrams() && datagrams_ != nullptr) {
    options->labels[kDatagramsLabel] = "true";
  }
  return options;
}

absl::Status PolicyHandler::OpenAgain(CallContext& context, SessionEntry& entry,
                                      const v1::OpenSessionRequest& request, Durability durability,
                                      v1::OpenSessionResponse* response) const {
  absl::MutexLock lock(&entry.mutex);
  const Session& session = entry.agent.session();
  const SessionOptions& opened = session.options;
  ASSIGN_OR_RETURN(auto options, OptionsOf(request, *entry.served));
  options.tenant = opened.tenant;
  options.durability = durability;
  options.policy = request.policy();
  if (request.version() != 0) options.version = request.version();
  if (request.record()) options.recording = opened.recording;
  const auto bytes = [](const SessionOptions& any) {
    return SerializeSession(NewSession("", any));
  };
  if (bytes(options) != bytes(opened) || request.record() == opened.recording.empty()) {
    return absl::AlreadyExistsError(
        absl::StrCat("session_id: expected an id that is not open, or the request that opened it, "
                     "received another request for ",
                     session.id));
  }
  if (SessionJournal* const journal = entry.journal.get(); journal != nullptr) {
    // Nothing in the request proves that this server still owns the session, or that it is open.
    const bool opens =
        journal->is_new() && journal->written() == 1 && journal->stored().records == 0;
    if (!opens && journal->is_shared()) journal->OnConfirm();
    context.commits.push_back(
        {.journal = entry.journal, .position = journal->written(), .opens = opens});
  }
  ToProto(request.session_id(), opened, *entry.served, response);
  return absl::OkStatus();
}

absl::StatusOr<std::unique_ptr<EpisodeRecorder>> PolicyHandler::NewRecorder(
    const std::shared_ptr<const ServedPolicy>& served, const std::string& tenant,
    std::string* name) const {
  if (recordings_ == nullptr) {
    return absl::FailedPreconditionError(
        "record: expected false, because the server runs without --record_dir, received true");
  }
  *name = Recordings::NewName(*served);
  return recordings_->Record(served, *name, tenant);
}

}  // namespace spikeserve
