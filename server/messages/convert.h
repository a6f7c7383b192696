// Converts between protobuf messages and the values of core. Contains no session logic.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/action/action_space.h"
#include "core/action/reported_action.h"
#include "core/agent/agent_session.h"
#include "core/agent/episode_recorder.h"
#include "core/agent/served_policy.h"
#include "core/agent/session_request.h"
#include "core/session/session.h"
#include "server/policies/policy_catalog.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Converts the settings of a new session; ResolveSession checks them. Returns INVALID_ARGUMENT for
// an unknown value of an enumeration.
absl::StatusOr<SessionRequest> RequestFromProto(const v1::OpenSessionRequest& request);

// Returns a view of `action`, which must outlive it.
ReportedAction FromProto(const v1::Action& action);

v1::ActionSpace ToProto(const ActionSpace& space);
void ToProto(const Action& action, bool discrete, v1::Action* proto);
void ToProto(const Hold& hold, v1::Hold* proto);
v1::Durability ToProto(Durability durability);
// REQUIRES: `entry` is the policy that `served` is a version of.
v1::PolicyInfo ToProto(const CatalogPolicy& entry, const ServedPolicy& served);
v1::RecordingState ToProto(RecordingState state);
v1::LearningSummary ToProto(const LearningSummary& summary);
v1::EndEpisodeResponse ToProto(const EpisodeSummary& summary);
// REQUIRES: `corrections` has steps.
void ToProto(const Corrections& corrections, v1::Corrections* proto);
v1::GetSessionResponse ToProto(const AgentSession& agent, bool include_head_delta);

// Fills in the response to one decision. Equal answers give equal bytes. REQUIRES: `policy`
// computed `answer`.
void ToProto(const std::string& session_id, const Answer& answer, const Policy& policy,
             v1::ActResponse* response);

// Adds the verdict about the wiring of the session, if there is one.
void WiringToProto(const AgentSession& agent, v1::ActResponse* response);

// Describes a session of `served` to the caller that opened it.
void ToProto(const std::string& session_id, const SessionOptions& options,
             const ServedPolicy& served, v1::OpenSessionResponse* response);

// Fills in the result of an item of a batch that failed with `status`.
void ErrorToProto(const absl::Status& status, v1::ActResult* result);

// Fills in the reply on a stream to a request that failed with `status`.
void ErrorToProto(const v1::ActRequest& request, const absl::Status& status,
                  v1::ActResponse* response);

}  // namespace spikeserve
