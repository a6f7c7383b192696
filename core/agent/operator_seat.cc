#include "core/agent/operator_seat.h"

#include <cmath>
#include <cstddef>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/json.h"
#include "core/base/status_macros.h"

namespace spikeserve {

OperatorSeat::OperatorSeat(const Clock* clock, const Session& session) : clock_(clock) {
  if (session.seat.has_value()) ends_ = clock->Now() + absl::Seconds(session.seat->left_seconds);
}

const Seat* OperatorSeat::Heard(Session* session, bool* is_over) const {
  *is_over = session->seat.has_value() && IsOver(*session);
  if (*is_over) session->seat.reset();
  if (!session->seat.has_value()) return nullptr;
  session->seat->left_seconds = absl::ToDoubleSeconds(ends_ - clock_->Now());
  return &*session->seat;
}

absl::Status OperatorSeat::Take(const Seat& seat, bool takes_over, Session* session) {
  const Seat* const taken = IsOver(*session) ? nullptr : &*session->seat;
  const bool renews = taken != nullptr && taken->lease_id == seat.lease_id;
  if (taken != nullptr && !renews && !takes_over) {
    return absl::FailedPreconditionError(
        absl::StrCat("take_over: expected true, because the operator ", Quoted(taken->operator_id),
                     " has control of the session, received false"));
  }
  Seat next = seat;
  next.left_seconds = seat.lease_seconds;
  if (renews) {
    next.steps = taken->steps;
    next.agreed_steps = taken->agreed_steps;
  }
  session->seat = std::move(next);
  ends_ = clock_->Now() + absl::Seconds(seat.lease_seconds);
  return absl::OkStatus();
}

absl::Status OperatorSeat::Steer(absl::string_view lease_id, const Action* action,
                                 Session* session) {
  RETURN_IF_ERROR(CheckLease(lease_id, *session));
  if (action != nullptr) session->seat->action = *action;
  ends_ = clock_->Now() + absl::Seconds(session->seat->lease_seconds);
  return absl::OkStatus();
}

absl::Status OperatorSeat::Return(absl::string_view lease_id, Session* session) {
  RETURN_IF_ERROR(CheckLease(lease_id, *session));
  session->seat.reset();
  return absl::OkStatus();
}

absl::Status OperatorSeat::CheckLease(absl::string_view lease_id, const Session& session) const {
  if (IsOver(session)) {
    return absl::FailedPreconditionError(
        absl::StrCat("lease_id: expected a lease that has not ended, received ", Quoted(lease_id)));
  }
  if (session.seat->lease_id == lease_id) return absl::OkStatus();
  return absl::FailedPreconditionError(
      absl::StrCat("lease_id: expected that of the operator ", Quoted(session.seat->operator_id),
                   ", who has control of the session, received ", Quoted(lease_id)));
}

void OperatorSeat::CountStep(const ActionSpace& space, const Action& of_policy, Session* session) {
  Seat& seat = *session->seat;
  ++seat.steps;
  seat.agreed_steps += Agree(space, of_policy, seat.action) ? 1 : 0;
}

bool Agree(const ActionSpace& space, const Action& a, const Action& b) {
  if (space.is_discrete()) return a.discrete == b.discrete;
  for (size_t i = 0; i < a.continuous.size(); ++i) {
    const float range = space.high[i] - space.low[i];
    if (!(std::abs(a.continuous[i] - b.continuous[i]) <= 0.1f * range)) return false;
  }
  return true;
}

}  // namespace spikeserve
