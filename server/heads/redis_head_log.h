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
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "core/fleet/head_entry.h"
#include "core/fleet/head_fold.h"
#include "core/store/redis_client.h"

namespace spikeserve {

enum class AppendOutcome {
  kAppended,
  kKnown,     // the log has had the entry before
  kStale,     // the log does not have the position that the caller is at: nothing was appended
  kSettling,  // the log was written again just now, and takes entries a few seconds later
};

// What was read of a log.
struct StoredLog {
  HeadPosition snapshot;        // of the last entry that the snapshot contains
  bool wants_snapshot = false;  // a server has asked for a newer one
  std::string bytes;            // HeadFold::Serialize(), if it was loaded; empty: no snapshot
  // Begins with the entry at the position from which it was read, if the log has it.
  std::vector<LoggedEntry> entries;
};

// The commands for one log. They take the client of one thread, block as it does, and return
// UNAVAILABLE if Redis cannot be reached. Thread-safe, because immutable.
class RedisHeadLog {
 public:
  // The largest number of entries that ReadTail() returns.
  static constexpr size_t kMostEntries = 256;

  // The log remembers for `retention` that it has an entry, and for ten minutes that it has the one
  // of the session's episode before.
  RedisHeadLog(absl::string_view policy, int64_t version, absl::string_view sha256,
               absl::Duration retention);

  const std::string& key() const { return log_; }

  // Sends the command that appends `entry`, of which `bytes` is the form, after whatever the log
  // has. `at` is the position of the caller; `members` are contributors with a session on this
  // server.
  void SendAppend(RedisClient& client, const HeadPosition& at, const HeadEntry& entry,
                  absl::string_view bytes, const std::vector<std::string>& members) const;
  static absl::StatusOr<AppendOutcome> ReadAppend(RedisClient& client);

  // Reads the entries from a position on.
  void SendTail(RedisClient& client, const HeadPosition& from) const;
  static absl::StatusOr<StoredLog> ReadTail(RedisClient& client);

  // Reads the snapshot, and all entries since.
  absl::StatusOr<StoredLog> Load(RedisClient& client) const;

  // Stores a snapshot and removes the entries before it. Does nothing if the log does not have the
  // entry of the snapshot, or the store has a snapshot that is as new and nobody asks for one.
  absl::Status StoreSnapshot(RedisClient& client, const HeadFold& heads) const;
  // Asks the other servers for a snapshot.
  absl::Status AskForSnapshot(RedisClient& client) const;

  // Replaces the log and its snapshot by `heads`, and remembers the last entries. For some seconds
  // the log then takes no entries, in which a server that has more replaces it again. UNAVAILABLE
  // if the log does not end with `expected_digest` any more.
  absl::Status Replace(RedisClient& client, absl::string_view expected_digest,
                       const HeadFold& heads) const;

  // Remembers that contributors to the heads of each tenant have a session on this server.
  absl::Status KeepMembers(RedisClient& client, const TenantHeads& heads) const;

 private:
  std::string MarkerOf(absl::string_view session, int64_t episode) const;

  std::string log_;
  std::string snapshot_;
  std::string marker_prefix_;
  std::string members_prefix_;
  std::string retention_;  // in milliseconds
};

}  // namespace spikeserve
