// Records what changed the served policies: an append-only file, the log, and the last entries in
// memory.
//
//   auto audit = AuditLog::Open("/var/lib/spikeserve/audit.jsonl");
//   if (auto status = (*audit)->Reserve(4096); !status.ok()) return status;  // nothing was changed
//   ...
//   (*audit)->Record({.time = absl::Now(), .action = "SetShadow", .policy = "cartpole", ...},
//   4096);
//
// Each line of the file is one entry, a JSON object. A line is there as a whole or not at all: what
// a full disk or a power cut leaves of one is removed. The file is opened for each entry, so it may
// be renamed at any time to rotate it.
//
// Calls of agents are in a file beside it, "audit.jsonl.agents", which is renamed to ".agents.1"
// when it is long. They are not flushed, and take neither the time nor the disk of operators: room
// for a thousand lines or so behind those of the log is kept on the disk. A full disk refuses new
// lines of agents; it removes none.
//
// Thread-safe.
#pragma once

#include <cstddef>
#include <deque>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "server/base/peer.h"

namespace spikeserve {

// One change; the fields are those of HistoryEntry in policy_admin.proto.
struct AuditEntry {
  absl::Time time;
  std::string action;
  std::string token = "";
  std::string tenant = "";
  Peer peer = {};
  std::string policy = "";
  std::string request = "";  // JSON
  absl::Status outcome = absl::OkStatus();
  std::string before = "";  // JSON
  std::string after = "";   // JSON
  // False: the call of an agent, which changes nothing that is served. Last() does not return it,
  // because such calls are frequent.
  bool is_operators = true;
};

class AuditLog {
 public:
  static constexpr size_t kRemembered = 1000;           // entries
  static constexpr size_t kRememberedBytes = 32 << 20;  // of their requests and states

  // Reads the last entries of the file at `path`, which is created if it does not exist; lines that
  // are no entries are skipped. If `path` is empty, entries go to the log and to memory alone.
  // Errors name --audit_log and the path.
  static absl::StatusOr<std::unique_ptr<AuditLog>> Open(const std::string& path);

  // Reserves room on the disk for an entry of an operator of `bytes`, until Record() is called with
  // them. Returns UNAVAILABLE, which names the path, if there is none. OK without a file.
  absl::Status Reserve(size_t bytes);

  // Writes an entry to the disk before it returns, without its states if only that fits. `reserved`
  // was given to Reserve(); 0: nothing was reserved. Returns DATA_LOSS if the entry could not be
  // written; the server's log has it, and the error.
  absl::Status Record(AuditEntry entry, size_t reserved = 0);

  // Returns the last `limit` entries for which `wanted` returns true, the latest first. `wanted` is
  // called under a lock of the log.
  std::vector<AuditEntry> Last(absl::FunctionRef<bool(const AuditEntry&)> wanted,
                               size_t limit) const;

 private:
  explicit AuditLog(std::string path) : path_(std::move(path)) {}

  absl::Status RecordOfOperator(AuditEntry entry, size_t reserved);
  // Appends a line to the file of agents.
  absl::Status AppendOfAgent(absl::string_view line);
  void Remember(AuditEntry entry) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  // Appends a line to the file and flushes it to the disk. Leaves room for what is reserved.
  absl::Status Append(absl::string_view line) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const std::string path_;  // empty: no file
  absl::Mutex agents_mutex_;
  mutable absl::Mutex mutex_;
  size_t reserved_ ABSL_GUARDED_BY(mutex_) = 0;             // bytes
  std::deque<AuditEntry> entries_ ABSL_GUARDED_BY(mutex_);  // the latest last
  size_t remembered_bytes_ ABSL_GUARDED_BY(mutex_) = 0;
};

}  // namespace spikeserve
