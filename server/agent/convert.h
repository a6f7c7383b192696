// Between the wire's messages and core's values. No rules of the game here, only translation.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_AGENT_CONVERT_H_
#define SERVER_AGENT_CONVERT_H_

#include <vector>

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

// INVALID_ARGUMENT for an unknown selection, or a temperature that is not positive or comes without
// SAMPLE.
absl::StatusOr<ActionSelection> SelectionFromProto(const v1::OpenSessionRequest& request);

// Unset fields get the defaults of LearningOptions. INVALID_ARGUMENT for an unknown name, a field
// that would do nothing, and whatever LearningOptions::Validate refuses.
absl::StatusOr<LearningOptions> LearningFromProto(const v1::LearningConfig& config,
                                                  const ActionSpace& space,
                                                  const ActionSelection& selection);

// The head's start beyond W_base, [act, d] or empty. INVALID_ARGUMENT names the field.
absl::StatusOr<std::vector<float>> HeadDeltaFromProto(const v1::OpenSessionRequest& request,
                                                      const Policy& policy);

v1::ActionSpace ToProto(const ActionSpace& space);
// `entry` is that of the policy `served` is a version of.
v1::PolicyInfo ToProto(const CatalogPolicy& entry, const ServedPolicy& served);
v1::EndEpisodeResponse ToProto(const EpisodeSummary& summary);
v1::GetSessionResponse ToProto(const AgentSession& agent, bool include_head_delta);

// Equal answers give equal bytes. `policy` made the answer.
void ToProto(const std::string& session_id, const Answer& answer, const Policy& policy,
             v1::ActResponse* response);

// A reply on a stream to a request that failed.
void ErrorToProto(const v1::ActRequest& request, const absl::Status& status,
                  v1::ActResponse* response);

}  // namespace spikeserve

#endif  // SERVER_AGENT_CONVERT_H_
