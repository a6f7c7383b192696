// Writes sessions as JSON for the status page. server/web/static/schema.json describes the format.
//
// Free functions, safe to call from many threads.
#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "core/open_sessions/session_store.h"
#include "server/access/authenticator.h"
#include "server/base/http_query.h"

namespace spikeserve {

// Returns {"open", "matching", "sessions", "next_page_token"}. "open" is the number of sessions
// that `caller` may read, "matching" the number of those that match the parameter `filter`.
// "sessions" holds a page of the matching ones, sorted by `sort` and `order`: the first `page_size`
// behind `page_token`, which is the "next_page_token" of the page before. Needs memory for one
// page, and one pass over all sessions. Returns INVALID_ARGUMENT, which names the parameter, if a
// parameter is not valid.
absl::StatusOr<std::string> SessionsJson(SessionStore& store, const Credential& caller,
                                         const HttpQuery& query);

// Returns one session with the history of its life, and its last observation beside the range in
// which an element is usual: `unusual_deviations` as in Metrics::NewPolicyObserver. NOT_FOUND if
// `caller` may not read a session with this id.
absl::StatusOr<std::string> SessionJson(SessionStore& store, const Credential& caller,
                                        const std::string& id, double unusual_deviations);

}  // namespace spikeserve
