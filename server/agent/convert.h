// Converts between protobuf messages and the values of core. Contains no session logic.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_AGENT_CONVERT_H_
#define SERVER_AGENT_CONVERT_H_

#include <vector>

#include "Eigen/Core"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/action/action_head.h"
#include "core/action/action_space.h"
#include "core/learning/learning_options.h"
#include "core/session/agent_session.h"
#include "core/session/served_policy.h"
#include "core/session/session.h"
#include "server/policies/policy_catalog.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Converts how a session selects actions. Returns INVALID_ARGUMENT for an unknown selection, for a
// temperature that is not a positive float32, or for a temperature without SAMPLE.
absl::StatusOr<ActionSelection> SelectionFromProto(const v1::OpenSessionRequest& request);

// Converts learning options; unset fields get the defaults of LearningOptions. Returns
// INVALID_ARGUMENT for an unknown name, for a field that would have no effect, and for options that
// LearningOptions::Validate refuses.
absl::StatusOr<LearningOptions> LearningFromProto(const v1::LearningConfig& config,
                                                  const ActionSpace& space,
                                                  const ActionSelection& selection);

// Returns the initial W - W_base of the session's action head: [act * d], row-major, or empty if
// the request has none. Returns INVALID_ARGUMENT, which names the field, for another size, for
// values that are not finite, and for a session that learns with scope FLEET.
absl::StatusOr<Eigen::VectorXf> HeadDeltaFromProto(const v1::OpenSessionRequest& request,
                                                   const Policy& policy);

v1::ActionSpace ToProto(const ActionSpace& space);
// REQUIRES: `entry` is the policy that `served` is a version of.
v1::PolicyInfo ToProto(const CatalogPolicy& entry, const ServedPolicy& served);
v1::EndEpisodeResponse ToProto(const EpisodeSummary& summary);
v1::GetSessionResponse ToProto(const AgentSession& agent, bool include_head_delta);

// Fills in the response to one decision. Equal answers give equal bytes. REQUIRES: `policy`
// computed `answer`.
void ToProto(const std::string& session_id, const Answer& answer, const Policy& policy,
             v1::ActResponse* response);

// Fills in the reply on a stream to a request that failed with `status`.
void ErrorToProto(const v1::ActRequest& request, const absl::Status& status,
                  v1::ActResponse* response);

}  // namespace spikeserve

#endif  // SERVER_AGENT_CONVERT_H_
