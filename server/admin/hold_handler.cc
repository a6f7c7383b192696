#include <algorithm>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "absl/algorithm/container.h"
#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/clock.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/journal/journal_entry.h"
#include "core/session/session_id.h"
#include "server/admin/admin_handler.h"
#include "server/base/log.h"
#include "server/messages/step_convert.h"

namespace spikeserve {
namespace {

constexpr size_t kLongestReason = 256;  // bytes
constexpr int32_t kLargestPage = 10000;

// Returns true if the caller may change a hold: it covers no session of a tenant that the caller
// does not see.
bool MayChange(const Credential& caller, const SessionHold& hold) {
  return caller.CanReadAll() ||
         (hold.selection.tenant.has_value() && caller.CanRead(*hold.selection.tenant));
}

// Returns true if the caller may see a hold: it covers sessions that the caller sees.
bool MaySee(const Credential& caller, const SessionHold& hold) {
  return !hold.selection.tenant.has_value() || caller.CanRead(*hold.selection.tenant);
}

absl::StatusOr<SessionSelection> SelectionFromProto(const v1::SessionSelection& proto,
                                                    const Credential& caller) {
  SessionSelection selection = {
      .policy = proto.policy(),
      .version = proto.version(),
      .labels = {proto.labels().begin(), proto.labels().end()},
      .session_ids = {proto.session_ids().begin(), proto.session_ids().end()}};
  if (!proto.tenant().empty()) selection.tenant = proto.tenant();
  const bool is_empty = selection == SessionSelection();
  if (is_empty && !proto.all()) {
    return InvalidArgument("selection", "a condition, or all for every session", "neither");
  }
  if (!selection.tenant.has_value() && !caller.CanReadAll()) {
    selection.tenant = caller.tenant()->name();
  }
  if (selection.tenant.has_value() && !caller.CanRead(*selection.tenant)) {
    return absl::PermissionDeniedError(
        absl::StrCat("selection.tenant: expected ", Quoted(caller.tenant()->name()),
                     ", the tenant of the token, received ", Quoted(*selection.tenant)));
  }
  RETURN_IF_ERROR(selection.Validate());
  return selection;
}

absl::StatusOr<SessionHold> HoldFromProto(const v1::HoldSessionsRequest& request,
                                          const Credential& caller) {
  SessionHold hold = {.hold = {request.id(), request.reason()},
                      .selection = {},
                      .since = absl::ToDoubleSeconds(absl::Now() - absl::UnixEpoch())};
  if (hold.hold.id.empty()) {
    ASSIGN_OR_RETURN(hold.hold.id, NewSessionId());
  }
  if (!IsPlainName(hold.hold.id)) {
    return InvalidArgument("id", "letters, digits, '.', '-', '_'", Quoted(request.id()));
  }
  if (request.reason().size() > kLongestReason) {
    return InvalidArgument("reason", absl::StrCat("at most ", kLongestReason, " bytes"),
                           request.reason().size());
  }
  ASSIGN_OR_RETURN(hold.selection, SelectionFromProto(request.selection(), caller));
  return hold;
}

// Gathers the page of held sessions that a caller asks for. Not thread-safe.
class HeldSessions {
 public:
  // Refers to its arguments.
  HeldSessions(const v1::ListHoldsRequest& request, const Credential& caller,
               const std::vector<const SessionHold*>& holds)
      : request_(request), caller_(caller), holds_(holds) {}

  // Adds the sessions of this server.
  void AddOpen(SessionStore& sessions) {
    sessions.ForEach([&](const SessionEntry& entry) { return caller_.CanRead(entry.tenant); },
                     [&](const ListedSession& listed) { AddListed(listed); });
  }

  // Adds the others that no living server has. Returns UNAVAILABLE if the store cannot be read.
  absl::Status AddStored(const JournalStore& journals, SessionStore& sessions) {
    return journals.VisitUnowned([&](const auto& stored_as, const auto& records) {
      const auto journal = ParseJournal(records);
      if (!journal.ok()) {
        LogWarning("stored session cannot be read, so that no hold lists it",
                   {{"session", stored_as}, {"error", std::string(journal.status().message())}});
        return;
      }
      const Session& session = journal->snapshot;
      const std::string& tenant = session.options.tenant;
      if (!caller_.CanRead(tenant) || open_.contains({tenant, session.id})) return;
      if (sessions.closed().Find(session.id, tenant) != nullptr) return;  // has no robot
      if (v1::HeldSession* const added = Add(session.id, session)) added->set_only_stored(true);
    });
  }

  void MovePageTo(v1::ListHoldsResponse* response) {
    absl::c_sort(page_,
                 [](const auto& a, const auto& b) { return a.session_id() < b.session_id(); });
    const size_t size = std::min(page_.size(), static_cast<size_t>(request_.page_size()));
    if (page_.size() > size) response->set_next_page_token(page_[size - 1].session_id());
    for (size_t i = 0; i < size; ++i) *response->add_sessions() = std::move(page_[i]);
  }

 private:
  void AddListed(const ListedSession& listed) {
    SessionEntry& entry = *listed.entry;
    if (request_.stored()) open_.emplace(entry.tenant, listed.id);
    absl::MutexLock lock(&entry.mutex);
    v1::HeldSession* const added = Add(listed.id, entry.agent.session());
    if (added == nullptr) return;
    added->set_at_neutral(entry.agent.is_at_neutral());
    added->set_idle_seconds(absl::ToDoubleSeconds(listed.idle));
    added->set_silent(IsSilent(entry.period, listed.idle));
    if (entry.journal != nullptr) added->set_epoch(entry.journal->epoch());
  }

  // Returns null if the session is not of the page, or no hold covers it.
  v1::HeldSession* Add(const std::string& id, const Session& session) {
    if (id <= request_.page_token()) return nullptr;
    const auto covering = absl::c_find_if(
        holds_, [&](const SessionHold* hold) { return hold->selection.Covers(session); });
    if (covering == holds_.end()) return nullptr;
    v1::HeldSession& held = page_.emplace_back();
    held.set_session_id(id);
    held.set_policy(session.options.policy);
    held.set_version(session.options.version);
    held.set_tenant(session.options.tenant);
    held.set_hold_id((*covering)->hold.id);
    return &held;
  }

  const v1::ListHoldsRequest& request_;
  const Credential& caller_;
  const std::vector<const SessionHold*>& holds_;
  std::vector<v1::HeldSession> page_;
  std::set<std::pair<std::string, std::string>> open_;  // sessions of this server: tenant and id
};

}  // namespace

void AdminHandler::Describe(const SessionHold& hold, const Credential& caller,
                            v1::HeldSelection* proto) const {
  const SessionSelection& selection = hold.selection;
  ToProto(hold.hold, proto->mutable_hold());
  proto->set_since(hold.since);
  v1::SessionSelection& selected = *proto->mutable_selection();
  selected.set_policy(selection.policy);
  selected.set_version(selection.version);
  selected.set_tenant(selection.tenant.value_or(""));
  selected.mutable_labels()->insert(selection.labels.begin(), selection.labels.end());
  selected.mutable_session_ids()->Add(selection.session_ids.begin(), selection.session_ids.end());
  selected.set_all(selection == SessionSelection());
  int64_t sessions = 0;
  parts_.store->ForEach([&](const SessionEntry& entry) { return caller.CanRead(entry.tenant); },
                        [&](const ListedSession& listed) {
                          absl::MutexLock lock(&listed.entry->mutex);
                          sessions += selection.Covers(listed.entry->agent.session()) ? 1 : 0;
                        });
  proto->set_sessions(sessions);
}

absl::Status AdminHandler::HoldSessions(CallContext& context,
                                        const v1::HoldSessionsRequest& request,
                                        v1::HoldSessionsResponse* response) const {
  ASSIGN_OR_RETURN(SessionHold hold, HoldFromProto(request, *context.caller));
  const auto add = [&](SessionHolds::List* holds) {
    const auto same = absl::c_find_if(
        *holds, [&](const SessionHold& other) { return other.hold.id == hold.hold.id; });
    if (same != holds->end()) {
      hold.since = same->since;
      hold.hold.reason = same->hold.reason;
      if (*same == hold) return absl::OkStatus();
      return absl::AlreadyExistsError(absl::StrCat(
          "id: expected one that no hold of another selection has, received ", hold.hold.id));
    }
    const auto of_tenant = absl::c_count_if(*holds, [&](const SessionHold& other) {
      return other.selection.tenant == hold.selection.tenant;
    });
    if (of_tenant >= kMostHolds) {
      return absl::ResourceExhaustedError(absl::StrCat("selection: expected fewer than ",
                                                       kMostHolds, " holds, received another one"));
    }
    holds->push_back(hold);
    return absl::OkStatus();
  };
  RETURN_IF_ERROR(parts_.registry->ChangeHolds(add));
  Describe(hold, *context.caller, response->mutable_hold());
  response->set_shared(parts_.registry->settings().is_shared());
  response->set_kept(parts_.registry->settings().is_kept());
  return absl::OkStatus();
}

absl::Status AdminHandler::ResumeSessions(CallContext& context,
                                          const v1::ResumeSessionsRequest& request,
                                          v1::ResumeSessionsResponse* response) const {
  SessionHold resumed;
  const auto remove = [&](SessionHolds::List* holds) {
    const auto found = absl::c_find_if(*holds, [&](const SessionHold& hold) {
      return hold.hold.id == request.id() && MayChange(*context.caller, hold);
    });
    if (found == holds->end()) {
      return absl::NotFoundError(
          absl::StrCat("id: expected that of a hold, received ", Quoted(request.id())));
    }
    resumed = *found;
    holds->erase(found);
    return absl::OkStatus();
  };
  RETURN_IF_ERROR(parts_.registry->ChangeHolds(remove));
  Describe(resumed, *context.caller, response->mutable_hold());
  response->set_shared(parts_.registry->settings().is_shared());
  return absl::OkStatus();
}

absl::Status AdminHandler::ListHolds(CallContext& context, const v1::ListHoldsRequest& request,
                                     v1::ListHoldsResponse* response) const {
  if (request.page_size() < 0 || request.page_size() > kLargestPage) {
    return InvalidArgument("page_size", absl::StrCat("0 to ", kLargestPage), request.page_size());
  }
  const Credential& caller = *context.caller;
  std::vector<const SessionHold*> holds;
  const auto all = parts_.registry->settings().holds().Get();
  for (const SessionHold& hold : *all) {
    if (!MaySee(caller, hold) || (!request.id().empty() && request.id() != hold.hold.id)) continue;
    holds.push_back(&hold);
    Describe(hold, caller, response->add_holds());
  }
  if (request.page_size() == 0) return absl::OkStatus();
  HeldSessions held(request, caller, holds);
  held.AddOpen(*parts_.store);
  if (request.stored() && parts_.journals != nullptr) {
    RETURN_IF_ERROR(held.AddStored(*parts_.journals, *parts_.store));
  }
  held.MovePageTo(response);
  return absl::OkStatus();
}

}  // namespace spikeserve
