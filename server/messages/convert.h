// Converts between protobuf messages and the values of core. Contains no session logic.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/action/action_space.h"
#include "core/agent/agent_session.h"
#include "core/agent/served_policy.h"
#include "core/agent/session_request.h"
#include "core/session/session.h"
#include "server/policies/policy_catalog.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Converts the settings of a new session; ResolveSession checks them. Returns INVALID_ARGUMENT for
// an unknown value of an enumeration.
absl::StatusOr<SessionRequest> RequestFromProto(const v1::OpenSessionRequest& request);

v1::ActionSpace ToProto(const ActionSpace& space);
v1::Durability ToProto(Durability durability);
// REQUIRES: `entry` is the policy that `served` is a version of.
v1::PolicyInfo ToProto(const CatalogPolicy& entry, const ServedPolicy& served);
// REQUIRES: `corrections` has steps.
void ToProto(const Corrections& corrections, v1::Corrections* proto);
v1::GetSessionResponse ToProto(const AgentSession& agent, bool include_head_delta);

// Describes a session of `served` to the caller that opened it.
void ToProto(const std::string& session_id, const SessionOptions& options,
             const ServedPolicy& served, v1::OpenSessionResponse* response);

}  // namespace spikeserve
