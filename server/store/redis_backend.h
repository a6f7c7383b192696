// Keeps journals in Redis, so that any of several servers can go on with a session.
//
// `{id}` is a hash tag, so that the keys of a session lie on one node of a cluster:
// - ss:{id}:o, a hash: epoch, owner, tenant and state (open or closed).
// - ss:{id}:<epoch>, a list: a snapshot, then entries.
// A claim renames the list to a later epoch. Appends are RPUSHX, which does nothing for a list
// that does not exist, so a former owner cannot append and finds out that it was replaced.
#ifndef SERVER_STORE_REDIS_BACKEND_H_
#define SERVER_STORE_REDIS_BACKEND_H_

#include <memory>

#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "core/store/redis_options.h"
#include "server/store/journal_backend.h"

namespace spikeserve {

// Connects at the first use, and again after every error. Redis removes a session that nothing was
// written to for `retention`. `owner` identifies this server, for people who look into Redis.
std::unique_ptr<JournalBackend> NewRedisBackend(RedisOptions options, absl::Duration retention,
                                                std::string owner);

}  // namespace spikeserve

#endif  // SERVER_STORE_REDIS_BACKEND_H_
