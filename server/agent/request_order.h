// Compares the place of a request in its session with what this server knows of the session.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_AGENT_REQUEST_ORDER_H_
#define SERVER_AGENT_REQUEST_ORDER_H_

#include <cstdint>
#include <optional>

#include "core/session/session.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Where a request belongs, as far as it says so.
struct Place {
  std::optional<int64_t> episode = std::nullopt;
  std::optional<uint64_t> decision = std::nullopt;  // decisions of the session before the request
  int64_t step = 0;                                 // decisions of the episode before the request
  // True: the request names its place in the session and not only in its episode, so that a copy of
  // the session that may answer it is the newest one.
  bool is_of_session = false;
};

Place PlaceOf(const v1::ActRequest& request);
Place PlaceOf(const v1::EndEpisodeRequest& request);

// Returns whether a request at `place` follows something that this copy of the session has not
// seen: a decision, or the end of an episode. Only another server can have answered that.
bool IsAhead(const Place& place, const Session& session);

}  // namespace spikeserve

#endif  // SERVER_AGENT_REQUEST_ORDER_H_
