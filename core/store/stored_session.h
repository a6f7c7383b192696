// How a session lies in a store: the names of its keys in Redis, and its description in a file.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <cstdint>
#include <string>

#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/fields.h"

namespace spikeserve {

// The tables of a file store: from ids to StoredSession, and from ids with the number of decisions
// to records.
inline constexpr char kSessionsTable[] = "sessions";
inline constexpr char kRecordsTable[] = "records";

// The length of the ids of sessions, which are hexadecimal digits.
inline constexpr size_t kStoredIdBytes = 32;

// Returns the id under which a store has session `id` of `tenant` if it has a session of another
// tenant under `id`: 128 bits of a hash of both. Therefore no tenant learns from an id that it
// chooses which ones others have.
std::string SecondStoredId(absl::string_view tenant, absl::string_view id);

// Returns the key of a record in a file: the session's id, then the number of decisions, which
// sorts. Records of equal numbers replace each other: the end of an episode replaces the entry of
// its last decision.
inline std::string StoredRecordKey(absl::string_view id, uint64_t decisions) {
  std::string key(id);
  for (int shift = 56; shift >= 0; shift -= 8) key.push_back(static_cast<char>(decisions >> shift));
  return key;
}

// Returns the number of decisions in the key of a record.
inline uint64_t StoredDecisions(absl::string_view key) {
  uint64_t decisions = 0;
  for (const char byte : key.substr(kStoredIdBytes)) {
    decisions = decisions << 8 | static_cast<uint8_t>(byte);
  }
  return decisions;
}

// The size that a file store may grow to. It takes only the space that it needs.
inline constexpr size_t kMostStoreBytes = size_t{64} << 30;

// What a file store knows of a session beside its records, and the name of its binary form.
struct StoredSession {
  std::string tenant;
  uint64_t epoch = 0;
  // When a record was written, to within a minute, by the clock of the store, which passes while a
  // server runs and begins at its time of day (Unix time); 0: unknown.
  int64_t written_seconds = 0;
};
inline constexpr char kStoredSessionFormat[] = "spikeserve.stored.v1";

SPIKESERVE_FIELDS(StoredSession, tenant, epoch, written_seconds)

// The keys of a session in Redis: ss:{id}:o, a hash, and ss:{id}:<epoch>, a list. `{id}` is a hash
// tag, so that the keys of a session lie on one node of a Cluster.
inline std::string RedisListPrefix(absl::string_view id) { return absl::StrCat("ss:{", id, "}:"); }
inline std::string RedisHashKey(absl::string_view id) {
  return absl::StrCat(RedisListPrefix(id), "o");
}
inline constexpr char kRedisSessionKeys[] = "ss:{*}:*";

// The servers that share a store in Redis, by the time at which they were alive last.
inline constexpr char kRedisReplicas[] = "r";

// A server that has not said for this long that it is alive counts as dead.
inline constexpr int64_t kAliveMilliseconds = 5000;

}  // namespace spikeserve
