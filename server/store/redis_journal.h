// How the journal of a session lies in Redis.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <cstdint>
#include <string>

#include "absl/random/random.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
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

}  // namespace spikeserve
