// Converts between core/robot, which has plain values, and the messages and times of the client.
//
// Free functions, safe to call from many threads.
#pragma once

#include <algorithm>
#include <optional>
#include <span>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "core/robot/link_events.h"
#include "core/robot/step_log.h"
#include "spikeserve/local_policy.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve::piloting {

// Returns `time`, at most 50 years: with an infinite one, sums with a clock would overflow.
inline robot::Time ToRobot(absl::Duration time) {
  return std::min(robot::Time(absl::ToInt64Nanoseconds(time)), robot::kNever / 2);
}
inline absl::Duration FromRobot(robot::Time time) { return absl::Nanoseconds(time.count()); }
inline std::span<const float> ToRobot(absl::Span<const float> values) {
  return {values.data(), values.size()};
}
inline robot::ActionView ToRobot(const ActionView& action) {
  return {action.discrete, ToRobot(action.continuous)};
}
inline robot::ChooserView ToRobot(const ChosenBy& by) {
  return {static_cast<robot::Chooser>(by.kind), {by.operator_id.data(), by.operator_id.size()}};
}
inline ActionView FromRobot(const robot::ActionView& action, const robot::ChooserView& by = {}) {
  return {action.discrete,
          {action.continuous.data(), action.continuous.size()},
          {static_cast<v1::ActionSource::Kind>(by.kind),
           {by.operator_id.data(), by.operator_id.size()}}};
}

// Returns the time of both clocks of the client (steady_time.h).
robot::Now ReadClocks();

// Returns the error of an episode whose end the server has not learned.
absl::Status LostEpisode(absl::string_view reason);
inline constexpr absl::string_view kClosed = "the pilot was closed";

// Returns a view of `action`, which is valid as long as that is not changed.
robot::ActionView ViewOf(const v1::Action& action);
robot::ChooserView ViewOf(const v1::ActionSource& source);
robot::ActionShape ShapeOf(const v1::ActionSpace& space);
robot::Opening OpeningOf(const v1::OpenSessionResponse& opened);
// Returns what an error means for the session. REQUIRES: it is one.
robot::Error ErrorOf(const absl::Status& status);
// Returns a view of `reply`. Its error is written to `error`.
robot::Reply ReplyOf(const v1::ActResponse& reply, robot::Error* error);

// Returns the return of an episode, or nothing if the server has repeated the steps alone: what a
// server decides costs energy.
std::optional<double> ReturnOf(const v1::EndEpisodeResponse& ended);

// Fill messages with a request of `log`, or with the end of its oldest episode. The session's id
// and `valid_until` stay absent.
void ToProto(const robot::StepLog& log, const robot::Request& request, v1::ActRequest* message);
void EndToProto(const robot::StepLog& log, v1::EndEpisodeRequest* message);

}  // namespace spikeserve::piloting
