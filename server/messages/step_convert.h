// Converts the requests for one session to steps of core, and their results, answers and errors to
// responses.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <string>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/time/time.h"
#include "core/action/reported_action.h"
#include "core/agent/episode_recorder.h"
#include "core/agent/robot_link.h"
#include "core/agent/step.h"
#include "core/open_sessions/session_store.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Returns whether `request` has beats, times or a report beside a request for one decision. The
// response then says more, too.
inline bool HasBeats(const v1::ActRequest& request) {
  return request.history_size() > 0 || request.has_observed_at() || request.has_report() ||
         request.skipped_rewards_size() > 0 || request.has_valid_until();
}

// Returns whether `request` has beats before its own.
inline bool HasPastBeats(const v1::ActRequest& request) {
  return request.history_size() > 0 || request.skipped_rewards_size() > 0;
}

// Returns a view of `action`, which must outlive it.
ReportedAction FromProto(const v1::Action& action);

void ToProto(const Action& action, bool discrete, v1::Action* proto);
void ToProto(const Hold& hold, v1::Hold* proto);
v1::RecordingState ToProto(RecordingState state);
v1::LearningSummary ToProto(const LearningSummary& summary);
v1::EndEpisodeResponse ToProto(const EpisodeSummary& summary);
v1::WiringVerdict ToProto(const WiringVerdict& verdict, const Policy& policy);

// Sets everything but the result of `step` to what `request`, which was received at `received`,
// asks of the session. If `is_next`, its step and decision do not count. Returns INVALID_ARGUMENT
// if `request` has an end of the episode that does not fit the rest. `step` has views of `request`.
absl::Status ToStep(const v1::ActRequest& request, absl::Duration received, bool is_next,
                    SessionEntry& entry, Step* step) ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex);
// As above, for the end of an episode.
void ToStep(const v1::EndEpisodeRequest& request, SessionEntry& entry, Step* step)
    ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex);

// Fills in the response to a request whose step was taken. REQUIRES: its status is OK.
void ToProto(const v1::ActRequest& request, const Step& step, absl::Duration received,
             const SessionEntry& entry, v1::ActResponse* response)
    ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex);
void ToProto(const Step& step, const SessionEntry& entry, v1::EndEpisodeResponse* response)
    ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex);

// Fills in the response to one decision. Equal answers give equal bytes. REQUIRES: `policy`
// computed `answer`.
void ToProto(const std::string& session_id, const Answer& answer, const Policy& policy,
             v1::ActResponse* response);

// Fills in the result of an item of a batch that failed with `status`.
void ErrorToProto(const absl::Status& status, v1::ActResult* result);

// Fills in the reply on a stream to a request that failed with `status`.
void ErrorToProto(const v1::ActRequest& request, const absl::Status& status,
                  v1::ActResponse* response);

// Fills in the counts of a robot.
void ToProto(const BeatCounts& counts, v1::BeatReport* report);

}  // namespace spikeserve
