// Ends the episode of a session as a request says: by EndEpisode, or behind the history of Act.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_AGENT_EPISODE_END_H_
#define SERVER_AGENT_EPISODE_END_H_

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "core/model/policy.h"
#include "core/open_sessions/session_store.h"
#include "server/trace/span.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Checks what does not depend on the session. Returns INVALID_ARGUMENT that names the field.
absl::Status CheckEnd(const v1::EndEpisodeRequest& end, const Policy& policy);
// As CheckEnd, for an Act request with end_episode.
absl::Status CheckEndBehindHistory(const v1::ActRequest& request, const Policy& policy);

// Ends the running episode and fills in the summary, or repeats that of the episode before if the
// request ended it and nothing was decided since. `call` is the span of the call. Errors do not
// change the session: FAILED_PRECONDITION for another episode or number of steps, and those of
// CheckEnd and AgentSession::EndEpisode.
absl::Status EndEpisodeOf(SessionEntry& entry, const v1::EndEpisodeRequest& request,
                          const Span& call, v1::EndEpisodeResponse* response)
    ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex);
// As EndEpisodeOf, for an Act request with end_episode whose history was appended. Repeats the
// summary whatever was decided since; if a restored session does not have it, returns the number of
// steps alone. REQUIRES: CheckEndBehindHistory returned OK.
absl::Status EndBehindHistory(SessionEntry& entry, const v1::ActRequest& request, const Span& call,
                              v1::EndEpisodeResponse* response)
    ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex);

}  // namespace spikeserve

#endif  // SERVER_AGENT_EPISODE_END_H_
