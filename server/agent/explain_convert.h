// Explanations as messages.
#ifndef SERVER_AGENT_EXPLAIN_CONVERT_H_
#define SERVER_AGENT_EXPLAIN_CONVERT_H_

#include "absl/status/status.h"
#include "core/session/explanation.h"
#include "core/session/served_policy.h"
#include "core/session/session.h"
#include "core/session/session_store.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// REQUIRES: `explanation` is of `session`, which has an answer, and `served` gave it. Thread-safe.
v1::ExplainResponse ToProto(const ServedPolicy& served, const Session& session,
                            const Explanation& explanation);

// Explains the last decision of a session. Takes long, but holds the session's lock for a moment
// only. Errors as Explain's of explanation.h. Thread-safe.
absl::Status ExplainSession(SessionEntry& entry, v1::ExplainResponse* response);

}  // namespace spikeserve

#endif  // SERVER_AGENT_EXPLAIN_CONVERT_H_
