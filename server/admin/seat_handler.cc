#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "core/action/action_space.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/session/session_id.h"
#include "server/admin/admin_handler.h"
#include "server/agent/session_gate.h"
#include "server/agent/session_recovery.h"
#include "server/messages/convert.h"
#include "server/messages/step_convert.h"

namespace spikeserve {
namespace {

constexpr double kDefaultLease = 1.0;  // seconds
constexpr double kShortestLease = 0.1;
constexpr double kLongestLease = 60.0;

absl::StatusOr<Action> ActionFromProto(const v1::Action& proto, const ActionSpace& space) {
  if (proto.has_discrete() != space.is_discrete() ||
      proto.has_continuous() == space.is_discrete()) {
    return InvalidArgument("action", space.is_discrete() ? "discrete" : "continuous",
                           proto.has_discrete()     ? "discrete"
                           : proto.has_continuous() ? "continuous"
                                                    : "neither");
  }
  const auto& values = proto.continuous().values();
  Action action = {.discrete = static_cast<int>(proto.discrete()),
                   .continuous = {values.begin(), values.end()}};
  if (proto.discrete() != action.discrete) action.discrete = -1;  // refused as any other
  RETURN_IF_ERROR(space.Contains(action));
  return action;
}

absl::StatusOr<Seat> SeatFromProto(const v1::TakeControlRequest& request,
                                   const Credential& caller) {
  Seat seat = {
      .operator_id = request.operator_id().empty() ? caller.name() : request.operator_id(),
      .lease_id = request.lease_id(),
      .lease_seconds = request.lease_seconds() == 0.0 ? kDefaultLease : request.lease_seconds(),
      .action = {}};
  if (seat.operator_id.empty() || seat.operator_id.size() > kLongestOperatorId) {
    return InvalidArgument("operator_id", absl::StrCat("1 to ", kLongestOperatorId, " bytes"),
                           absl::StrCat(seat.operator_id.size(), ", and the token has no name"));
  }
  if (!(seat.lease_seconds >= kShortestLease && seat.lease_seconds <= kLongestLease)) {
    return InvalidArgument("lease_seconds", absl::StrCat(kShortestLease, " to ", kLongestLease),
                           request.lease_seconds());
  }
  if (seat.lease_id.empty()) {
    ASSIGN_OR_RETURN(seat.lease_id, NewSessionId());
  }
  if (!IsDrawnSessionId(seat.lease_id)) {
    return InvalidArgument("lease_id", "32 hexadecimal digits", Quoted(seat.lease_id));
  }
  return seat;
}

// Returns UNAVAILABLE if the store could not be told of a change, which then must not happen.
absl::Status CheckReachable(const SessionEntry& entry) {
  return entry.journal == nullptr ? absl::OkStatus() : entry.journal->CheckReachable();
}

// Returns what the answer to a change of the seat waits for: a refusal, that the session is here.
Await AwaitOf(const absl::Status& status) {
  return status.ok() ? Await::kStored : Await::kConfirmed;
}

}  // namespace

absl::StatusOr<std::shared_ptr<SessionEntry>> AdminHandler::Find(const CallContext& context,
                                                                 const std::string& id) const {
  auto entry = parts_.store->Peek(id, context.caller->tenant()->name());
  const bool is_here = entry != nullptr && context.caller->CanRead(entry->tenant) &&
                       (entry->journal == nullptr || !entry->journal->lost());
  if (is_here) return entry;
  return NoSuchSession(id);
}

absl::Status AdminHandler::TakeControl(CallContext& context, const v1::TakeControlRequest& request,
                                       v1::TakeControlResponse* response) const {
  ASSIGN_OR_RETURN(Seat seat, SeatFromProto(request, *context.caller));
  ASSIGN_OR_RETURN(const auto entry, Find(context, request.session_id()));
  RETURN_IF_ERROR(CheckReachable(*entry));
  absl::MutexLock lock(&entry->mutex);
  const ActionSpace& space = entry->served->policy().action_space;
  const Seat* const taken = entry->agent.seat();
  if (request.has_action()) {
    ASSIGN_OR_RETURN(seat.action, ActionFromProto(request.action(), space));
  } else {
    seat.action = taken == nullptr ? NeutralAction(space) : taken->action;
  }
  if (taken != nullptr && taken->lease_id != seat.lease_id) {
    response->set_relieved_operator_id(taken->operator_id);
  }
  const auto status = entry->agent.TakeControl(seat, request.take_over());
  AddCommit(*entry, AwaitOf(status), &context.commits);
  RETURN_IF_ERROR(status);
  entry->was_taken.store(true, std::memory_order_relaxed);
  response->set_lease_id(seat.lease_id);
  response->set_operator_id(seat.operator_id);
  *response->mutable_action_space() = ToProto(space);
  ToProto(seat.action, space.is_discrete(), response->mutable_action());
  return absl::OkStatus();
}

absl::Status AdminHandler::SteerSession(CallContext& context,
                                        const v1::SteerSessionRequest& request,
                                        v1::SteerSessionResponse* response) const {
  ASSIGN_OR_RETURN(const auto entry, Find(context, request.session_id()));
  RETURN_IF_ERROR(CheckReachable(*entry));
  absl::MutexLock lock(&entry->mutex);
  AgentSession& agent = entry->agent;
  Action action;
  if (request.has_action()) {
    ASSIGN_OR_RETURN(action, ActionFromProto(request.action(), agent.policy().action_space));
  }
  AddCommit(*entry, Await::kConfirmed, &context.commits);
  RETURN_IF_ERROR(agent.Steer(request.lease_id(), request.has_action() ? &action : nullptr));
  const Session& session = agent.session();
  response->set_steps(session.seat->steps);
  response->set_agreed_steps(session.seat->agreed_steps);
  response->set_next_step(session.step);
  if (agent.hold() != nullptr) ToProto(*agent.hold(), response->mutable_hold());
  return absl::OkStatus();
}

absl::Status AdminHandler::ReturnControl(CallContext& context,
                                         const v1::ReturnControlRequest& request,
                                         v1::ReturnControlResponse* response) const {
  ASSIGN_OR_RETURN(const auto entry, Find(context, request.session_id()));
  RETURN_IF_ERROR(CheckReachable(*entry));
  absl::MutexLock lock(&entry->mutex);
  const Seat seat = entry->agent.session().seat.value_or(Seat());
  const auto status = entry->agent.ReturnControl(request.lease_id());
  AddCommit(*entry, AwaitOf(status), &context.commits);
  RETURN_IF_ERROR(status);
  response->set_steps(seat.steps);
  response->set_agreed_steps(seat.agreed_steps);
  return absl::OkStatus();
}

}  // namespace spikeserve
