// Decides which operator is heard in a session, if any: one at a time, by a lease that ends by
// itself (docs/design/operators.md).
//
//   OperatorSeat seat(clock, session);
//   RETURN_IF_ERROR(seat.Take({.operator_id = "ann", .lease_id = id, ...}, false, &session));
//   if (const Seat* taken = seat.Heard(&session)) Execute(taken->action);
//
// Not thread-safe: protected by the lock of its session.
#pragma once

#include <array>
#include <cstddef>
#include <string>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "core/action/action_space.h"
#include "core/base/clock.h"
#include "core/base/enum_names.h"
#include "core/session/session.h"

namespace spikeserve {

// What becomes of an operator's control of a session.
enum class SeatChange {
  kTaken,      // from the policy
  kTakenOver,  // from another operator
  kReturned,
  kEnded  // with its lease, as the next request has found
};
inline constexpr size_t kSeatChanges = 4;

constexpr std::array<EnumName<SeatChange>, kSeatChanges> EnumNames(SeatChange) {
  return {{{SeatChange::kTaken, "taken"},
           {SeatChange::kTakenOver, "taken_over"},
           {SeatChange::kReturned, "returned"},
           {SeatChange::kEnded, "ended"}}};
}

// `session` is the same one in all calls.
class OperatorSeat {
 public:
  // Goes on with the lease of a restored session. `clock` must outlive the seat.
  OperatorSeat(const Clock* clock, const Session& session);

  // Returns whether no operator has control: none has taken it, or the lease has ended.
  bool IsOver(const Session& session) const {
    return !session.seat.has_value() || clock_->Now() >= ends_;
  }
  // Returns the operator who has control, and notes what is left of the lease; null: none. Forgets
  // a lease that has ended, and sets `is_over` then.
  const Seat* Heard(Session* session, bool* is_over) const;

  // Gives the session to the operator of `seat`, for `seat.lease_seconds` from now on; the same
  // lease_id renews. FAILED_PRECONDITION, which names the operator, if another one has it, unless
  // `takes_over`.
  absl::Status Take(const Seat& seat, bool takes_over, Session* session);
  // Renews the lease, and takes the operator's next action unless it is null. FAILED_PRECONDITION
  // if `lease_id` is not that of the session.
  absl::Status Steer(absl::string_view lease_id, const Action* action, Session* session);
  // Ends the lease. Errors as Steer.
  absl::Status Return(absl::string_view lease_id, Session* session);

  // Counts a decision of the policy that the operator's action replaces. REQUIRES: Heard() has just
  // returned the seat.
  static void CountStep(const ActionSpace& space, const Action& of_policy, Session* session);

 private:
  absl::Status CheckLease(absl::string_view lease_id, const Session& session) const;

  const Clock* clock_;
  absl::Duration ends_;  // of the clock
};

// Returns whether two actions are the same: of a Box, within a tenth of each element's range.
// Thread-safe.
bool Agree(const ActionSpace& space, const Action& a, const Action& b);

}  // namespace spikeserve
