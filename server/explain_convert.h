// Explanations as messages.
#ifndef SERVER_EXPLAIN_CONVERT_H_
#define SERVER_EXPLAIN_CONVERT_H_

#include "core/session/explanation.h"
#include "core/session/served_policy.h"
#include "core/session/session.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// REQUIRES: `explanation` is of `session`, which has an answer, and `served` gave it. Thread-safe.
v1::ExplainResponse ToProto(const ServedPolicy& served, const Session& session,
                            const Explanation& explanation);

}  // namespace spikeserve

#endif  // SERVER_EXPLAIN_CONVERT_H_
