// The log of a policy version's heads in Redis.
//
// `{policy@version}` is a hash tag, so that the keys of a log lie on one node of a cluster. <file>
// is the beginning of the SHA-256 of the policy's file: servers with other bytes learn other heads.
// - fl:{policy@version}:<file>, a stream: the entries.
// - fs:{policy@version}:<file>, a hash: a snapshot of the heads with the position that it stands
//   for, whether a server has asked for a newer one, which run of Redis had the log last, and since
//   when the servers look whether they have more than it.
// - fc:{policy@version}:<session>:<episode>: the entry is in the log.
// - fm:{policy@version}:<file>:<tenant>, a sorted set: contributors with a session, by the time at
//   which a server has said so last.
//
// Free functions without shared state. They take the client of one thread, block as it does, and
// return UNAVAILABLE if Redis cannot be reached.
#ifndef SERVER_HEADS_REDIS_HEAD_LOG_H_
#define SERVER_HEADS_REDIS_HEAD_LOG_H_

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "core/store/redis_client.h"
#include "server/heads/head_entry.h"

namespace spikeserve {

// The names of the keys of one log.
struct HeadLogKeys {
  HeadLogKeys(absl::string_view policy, int64_t version, absl::string_view sha256);

  std::string log;
  std::string snapshot;
  std::string marker_prefix;
  std::string members_prefix;
};

// How an entry is appended.
struct HeadAppend {
  std::string session;
  int64_t episode = 0;
  std::string head;
  std::string bytes;
  std::string identity;              // HeadEntryIdentity()
  std::vector<std::string> members;  // contributors with a session on this server
};

enum class AppendOutcome {
  kAppended,
  kKnown,     // the log has had the entry before
  kStale,     // the log does not have the position that the caller is at: nothing was appended
  kSettling,  // the log was written again just now, and takes entries a few seconds later
};

// Sends the command that appends an entry after whatever the log has. The log remembers the entry
// for `retention`, and the one of the session's episode before for ten more minutes. `at` is the
// position of the caller.
void SendHeadAppend(RedisClient& client, const HeadLogKeys& keys, const HeadPosition& at,
                    const HeadAppend& append, absl::Duration retention);
absl::StatusOr<AppendOutcome> ReadHeadAppend(RedisClient& client);

// The entries of a log from a position on.
struct LogTail {
  int64_t snapshot_number = 0;       // of the last entry that the snapshot contains
  bool wants_snapshot = false;       // a server has asked for a newer snapshot
  std::vector<LoggedEntry> entries;  // the first is the one at the position, if the log has it
};
// The largest number of entries of a LogTail.
inline constexpr size_t kMostTailEntries = 256;

void SendHeadTail(RedisClient& client, const HeadLogKeys& keys, const HeadPosition& from);
absl::StatusOr<LogTail> ReadHeadTail(RedisClient& client);

// A snapshot, and all entries since.
struct StoredLog {
  HeadPosition snapshot;
  std::string bytes;                 // HeadReplica::Serialize(); empty: no snapshot
  std::vector<LoggedEntry> entries;  // may begin with the one of the snapshot
};
absl::StatusOr<StoredLog> LoadHeadLog(RedisClient& client, const HeadLogKeys& keys);

// Stores a snapshot and removes the entries before it. Does nothing if the log does not have the
// entry of the snapshot, or the store has a snapshot that is as new and nobody asks for one.
absl::Status StoreHeadSnapshot(RedisClient& client, const HeadLogKeys& keys,
                               const HeadPosition& position, absl::string_view bytes);

// Replaces the log and its snapshot by this one. For some seconds the log then takes no entries, in
// which a server that has more replaces it again. Returns ABORTED if the log does not end with
// `expected_digest` any more.
absl::Status ReplaceHeadLog(RedisClient& client, const HeadLogKeys& keys,
                            absl::string_view expected_digest, const HeadPosition& position,
                            absl::string_view bytes);

// The session and the episode of an entry, and its id in the log.
struct HeadMarker {
  std::string session;
  int64_t episode = 0;
  std::string id;
};

// Lets the log remember for `retention` that it has had these entries.
absl::Status RestoreHeadMarkers(RedisClient& client, const HeadLogKeys& keys,
                                absl::Span<const HeadMarker> markers, absl::Duration retention);

// Asks the other servers for a snapshot.
absl::Status AskForHeadSnapshot(RedisClient& client, const HeadLogKeys& keys);

// Sends the command that says that the contributors have a session on this server. Its reply has no
// meaning.
void SendHeadMembers(RedisClient& client, const HeadLogKeys& keys, absl::string_view head,
                     const std::vector<std::string>& members);

}  // namespace spikeserve

#endif  // SERVER_HEADS_REDIS_HEAD_LOG_H_
