// Compares the place of a request in its session with what this server knows of the session.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_AGENT_REQUEST_ORDER_H_
#define SERVER_AGENT_REQUEST_ORDER_H_

#include "core/session/session.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Returns whether the request follows something that this copy of the session has not seen: a
// decision, or the end of an episode. Only another server can have answered that.
bool IsAhead(const v1::ActRequest& request, const Session& session);
bool IsAhead(const v1::EndEpisodeRequest& request, const Session& session);

// Returns whether a copy of the session that may answer the request is the newest one: the request
// names its place in the session and not only in its episode.
bool NamesPlace(const v1::ActRequest& request);
bool NamesPlace(const v1::EndEpisodeRequest& request);

}  // namespace spikeserve

#endif  // SERVER_AGENT_REQUEST_ORDER_H_
