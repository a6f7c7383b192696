// How the journal of a session lies in Redis, and what replies about it hold.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>

#include "absl/random/random.h"
#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/store/redis_client.h"
#include "core/store/stored_session.h"

namespace spikeserve {

// Returns the key of the list with the records that the owner of `epoch` has written.
inline std::string RedisListKey(absl::string_view id, absl::string_view epoch) {
  return absl::StrCat(RedisListPrefix(id), epoch);
}

// Returns the epoch of a claim of what the store has at `epoch`: a random number is added. If a
// primary fails and its replica did not have the last claim yet, the next claim then gets another
// epoch, and the two owners do not append to one list. A journal that is moved gets its new epoch
// in the same way.
inline uint64_t NextRedisEpoch(uint64_t epoch, absl::BitGen& random) {
  return epoch + absl::Uniform(random, 1U, 1U << 20);
}

// Returns the text of an element of an array. REQUIRES: the array has it.
inline std::string TextAt(const redisReply& reply, size_t i) {
  return std::string(TextOf(*reply.element[i]));
}

inline bool IsArray(const redisReply& reply, size_t elements) {
  return reply.type == REDIS_REPLY_ARRAY && reply.elements == elements;
}

// Returns UNAVAILABLE, for a reply that is none of those that the command can have.
inline absl::Status UnexpectedReply(absl::string_view expected) {
  return absl::UnavailableError(absl::StrCat("session store: expected ", expected));
}

}  // namespace spikeserve
