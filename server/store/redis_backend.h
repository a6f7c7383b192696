// Keeps journals in Redis, so that any of several servers can continue with a session.
//
// `{id}` is a hash tag, so that the keys of a session lie on one node of a cluster:
// - ss:{id}:o, a hash: epoch, owner, tenant, state (open or closed), the file of the policy, and
// the
//   base: which of its owner's records the list begins with; 0 if it was claimed.
// - ss:{id}:<epoch>, a list: a snapshot, then entries.
// A claim renames the list to a later epoch. Appends are RPUSHX, which does nothing for a list
// that does not exist, so a former owner cannot append and finds out that it was replaced. The base
// and the length of the list tell an owner whether Redis has all that it has acknowledged.
#pragma once

#include <memory>

#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "core/store/redis_options.h"
#include "server/store/journal_backend.h"

namespace spikeserve {

// Connects at the first use, and again after every error. Redis removes a session that nothing was
// used for `retention`. `owner` identifies this server. `may_evict`: Redis may remove sessions when
// its memory is full, and SYNC is allowed nevertheless.
std::unique_ptr<JournalBackend> NewRedisBackend(RedisOptions options, absl::Duration retention,
                                                std::string owner, bool may_evict = false);

}  // namespace spikeserve
