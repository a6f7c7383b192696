#include "server/store/redis_claims.h"

#include <cstddef>
#include <cstdint>
#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/session/session_id.h"
#include "core/store/stored_session.h"
#include "server/store/lost_session.h"
#include "server/store/redis_journal.h"
#include "server/store/redis_scripts.h"

namespace spikeserve {
namespace {

// How often a claim is tried again that another server was faster than.
constexpr int kMostClaims = 3;

// A claim under way.
struct ClaimState {
  const JournalClaim* claim = nullptr;
  absl::StatusOr<ClaimedJournal>* result = nullptr;
  std::string id = "";     // under which the store may have the session
  std::string found = "";  // epoch in the store
  uint64_t epoch = 0;      // new; 0: the session is left to its owner
};

// Sets the epochs of a claim from what the store has of its session. Returns false if the claim is
// done, with a result, unless it has another id now, under which to look for it.
bool TakeFound(const redisReply& reply, absl::BitGen& random, ClaimState* state) {
  const JournalClaim& claim = *state->claim;
  uint64_t epoch = 0;
  if (!IsArrayOf(reply, 4)) {
    *state->result = UnexpectedReply("four fields");
    return false;
  }
  state->found = TextAt(reply, 0);
  const std::string tenant = TextAt(reply, 1);
  const bool is_closed = TextAt(reply, 2) == "closed";  // by an older release: without tenant
  const bool is_elsewhere = tenant != claim.tenant && !(is_closed && tenant.empty());
  if (is_elsewhere && state->id == claim.id) state->id = SecondStoredId(claim.tenant, claim.id);
  if (state->found.empty()) {
    *state->result = MarkLost(NoSuchSession(claim.id));
    return false;
  }
  if (!absl::SimpleAtoi(state->found, &epoch) || tenant != claim.tenant ||
      TextAt(reply, 2) != "open") {
    *state->result = NoSuchSession(claim.id);
    return false;
  }
  const std::string policy = TextAt(reply, 3);
  const bool has_it = policy.empty() || claim.has_policy == nullptr || claim.has_policy(policy);
  state->epoch = has_it && !claim.only_reads ? NextRedisEpoch(epoch, random) : 0;
  return true;
}

// Begins claims: finds the sessions. Those that are done have a result afterwards.
std::vector<ClaimState> FindClaims(RedisClient& client, std::vector<ClaimState> claims,
                                   absl::BitGen& random) {
  for (const ClaimState& state : claims) {
    client.Append({"HMGET", RedisHashKey(state.id), "epoch", "tenant", "state", "policy"});
  }
  std::vector<ClaimState> found;
  std::vector<ClaimState> elsewhere;
  for (ClaimState& state : claims) {
    const std::string id = state.id;
    const auto reply = client.Read();
    if (!reply.ok()) {
      *state.result = reply.status();
    } else if (TakeFound(**reply, random, &state)) {
      found.push_back(std::move(state));
    } else if (state.id != id) {
      elsewhere.push_back(std::move(state));
    }
  }
  if (elsewhere.empty()) return found;
  for (ClaimState& state : FindClaims(client, std::move(elsewhere), random)) {
    found.push_back(std::move(state));
  }
  return found;
}

void AppendClaim(RedisClient& client, const RedisClaimant& claimant, const ClaimState& state) {
  const std::string& id = state.id;
  const std::string list = RedisListKey(id, state.found);
  if (state.epoch == 0) {
    return client.Append({"LRANGE", list, "0", state.claim->only_reads ? "-1" : "0"});
  }
  const std::string epoch = absl::StrCat(state.epoch);
  client.Append({"EVAL", redis_scripts::kClaim, "3", RedisHashKey(id), list,
                 RedisListKey(id, epoch), state.found, epoch, claimant.owner, claimant.retention});
}

// Runs the claims that were found, and returns those that are to be tried again.
std::vector<ClaimState> RunClaims(RedisClient& client, const RedisClaimant& claimant,
                                  std::vector<ClaimState> claims) {
  for (const ClaimState& state : claims) AppendClaim(client, claimant, state);
  std::vector<ClaimState> again;
  for (ClaimState& state : claims) {
    const auto reply = client.Read();
    if (!reply.ok()) {
      *state.result = reply.status();
      continue;
    }
    const bool is_list = (*reply)->type == REDIS_REPLY_ARRAY;
    const bool is_gone = (*reply)->type == REDIS_REPLY_NIL || (is_list && (*reply)->elements == 0);
    if (is_gone) *state.result = MarkLost(NoSuchSession(state.claim->id));
    if (is_gone || !is_list) {  // unless another server has moved it meanwhile
      again.push_back(std::move(state));
      continue;
    }
    ClaimedJournal journal = {.epoch = state.epoch, .records = {}, .stored_as = state.id};
    if (!absl::SimpleAtoi(state.found, &journal.claimed_from)) journal.claimed_from = 0;
    for (size_t i = 0; i < (*reply)->elements; ++i) journal.records.push_back(TextAt(**reply, i));
    *state.result = std::move(journal);
  }
  return again;
}

}  // namespace

std::vector<absl::StatusOr<ClaimedJournal>> ClaimRedisJournals(
    RedisClient& client, const RedisClaimant& claimant, absl::Span<const JournalClaim> claims,
    absl::BitGen& random) {
  std::vector<absl::StatusOr<ClaimedJournal>> results(
      claims.size(), UnexpectedReply("a session that stays at one server; try again"));
  std::vector<ClaimState> waiting;
  for (size_t i = 0; i < claims.size(); ++i)
    waiting.push_back({&claims[i], &results[i], claims[i].id});
  for (int i = 0; i < kMostClaims && !waiting.empty(); ++i) {
    waiting = RunClaims(client, claimant, FindClaims(client, std::move(waiting), random));
  }
  return results;
}

}  // namespace spikeserve
