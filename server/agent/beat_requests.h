// Takes what a request of a robot on a real link has beside a request for one decision: the beats
// before it, the time of its observation, and a report.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_AGENT_BEAT_REQUESTS_H_
#define SERVER_AGENT_BEAT_REQUESTS_H_

#include <cstdint>
#include <optional>

#include "absl/functional/function_ref.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "core/action/reported_action.h"
#include "core/agent/agent_session.h"
#include "core/agent/beats.h"
#include "core/agent/robot_link.h"
#include "core/base/clock.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// What was done for a request so far. A request with a long history is handled in several parts, so
// that others need not wait for all of it.
struct BeatProgress {
  int64_t appended = 0;  // beats
  int64_t dropped = 0;   // beats
  absl::Duration spent;  // on appending
  bool started = false;
  bool checked = false;  // the whole history
  bool finished = true;  // false: the request continues with its next part
  bool expired = false;
};

// The most beats that one group of requests appends.
inline constexpr int64_t kBeatsPerGroup = 32;

// What the requests of one turn of a loop may append together, so that those without history wait
// for as little as if there were one such request.
struct BeatBudget {
  int64_t beats = kBeatsPerGroup;
  absl::Duration until = absl::InfiniteDuration();  // time of the clock
};

// Returns whether `request` has any of it. The other functions are for these requests.
inline bool HasBeats(const v1::ActRequest& request) {
  return request.history_size() > 0 || request.has_observed_at() || request.has_report() ||
         request.skipped_rewards_size() > 0 || request.has_valid_until();
}

// Returns whether `request` has beats before its own.
inline bool HasPastBeats(const v1::ActRequest& request) {
  return request.history_size() > 0 || request.skipped_rewards_size() > 0;
}

// Returns the action that was executed before the request's step, if it says so.
std::optional<ReportedAction> ExecutedBefore(const v1::ActRequest& request);

// Takes the next part of a request that was received at `received`: appends beats as far as
// `budget` goes, which it reduces; rewards of skipped steps, and checks, count as a part of a beat.
// Sets `progress`. Returns whether the decision is to be made now; false: it is not yet, or not at
// all. Calls `on_appended` for each beat. Errors as for AppendBeats, and INVALID_ARGUMENT for
// valid_until without observed_at.
absl::StatusOr<bool> TakeBeats(const v1::ActRequest& request, absl::Duration received,
                               const Clock& clock, SessionObserver& observer, bool is_new_session,
                               AgentSession* agent, RobotLink* robot, BeatBudget* budget,
                               BeatProgress* progress,
                               absl::FunctionRef<void(const Beat&)> on_appended);

// Fills in what the response to such a request says about it. `begun` is when the decision began.
void FillBeats(const v1::ActRequest& request, const BeatProgress& progress, const Session& session,
               absl::Duration received, absl::Duration begun, v1::ActResponse* response);

// Returns the report as counts.
BeatCounts FromProto(const v1::BeatReport& report);
void ToProto(const BeatCounts& counts, v1::BeatReport* report);

}  // namespace spikeserve

#endif  // SERVER_AGENT_BEAT_REQUESTS_H_
