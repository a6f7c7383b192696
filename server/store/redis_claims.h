// Claims the journals of sessions in Redis for a new owner.
//
// A free function without shared state.
#pragma once

#include <string>
#include <vector>

#include "absl/random/random.h"
#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/store/redis_client.h"
#include "server/store/journal_backend.h"

namespace spikeserve {

// Who claims.
struct RedisClaimant {
  std::string owner;
  std::string retention;  // of what is claimed, in milliseconds
};

// Returns the result of each claim, as JournalBackend::Claim() does. Blocks as `client` does. An
// error of a claim may be one of its connection.
std::vector<absl::StatusOr<ClaimedJournal>> ClaimRedisJournals(
    RedisClient& client, const RedisClaimant& claimant, absl::Span<const JournalClaim> claims,
    absl::BitGen& random);

}  // namespace spikeserve
