// Explains decisions and converts the explanations to messages.
#pragma once

#include "absl/status/status.h"
#include "core/agent/explanation.h"
#include "core/agent/served_policy.h"
#include "core/open_sessions/session_store.h"
#include "core/session/session.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Converts an explanation to a message. REQUIRES: `served` gave session.last_answer, and
// `explanation` explains it. Thread-safe.
v1::ExplainResponse ToProto(const ServedPolicy& served, const Session& session,
                            const Explanation& explanation);

// Converts the last decision of a session to a message without spikes, attention and gates, which
// takes microseconds. REQUIRES: `served` gave session.last_answer. Thread-safe.
v1::ExplainResponse DecisionToProto(const ServedPolicy& served, const Session& session);

// Explains the last decision of a session. Takes about a thousand times as long as the decision,
// but holds the session's lock only while it copies the session. Errors: see Explain in
// explanation.h. Thread-safe.
absl::Status ExplainSession(SessionEntry& entry, v1::ExplainResponse* response);

}  // namespace spikeserve
