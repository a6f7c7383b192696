// Keeps journals in a folder of this machine, so that sessions survive a restart, a crash and a
// power cut. Uses LMDB. What was written together is on the disk when Write() returns.
//
// A damaged file is replaced by what can be read of it, when it is opened and when LMDB meets the
// damage later (core/store/file_repair.h). Some room on the disk is kept in reserve: if the disk is
// full, Write() still ends sessions, and refuses the other records. The file does not shrink, but
// what has ended makes room in it for others.
//
// The age of a session is time that a server runs: neither a time of day that jumps nor the time
// between two servers makes a session older.
//
// Not thread-safe.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "server/store/journal_backend.h"

namespace spikeserve {

// Reads the journals of a store that is opened. Null functions: none is read.
struct JournalVisitor {
  // Called with the folder of the store, which this process has locked.
  std::function<absl::Status(const std::string& directory)> begin;
  // Returns whether the journal of a session with so many decisions is to be read.
  std::function<bool(const std::string& id, uint64_t decisions)> wants;
  std::function<void(const std::string& id, std::vector<std::string> records)> visit;
  // Called when `wants` has been asked about every session.
  std::function<absl::Status()> end;
};

// Opens the store in `directory`, which is created if it does not exist, and removes the sessions
// that nothing was written to for `retention`, after `visitor` has seen them. `now` returns the
// time of day; `clock`, which must outlive the backend, that which passes. INVALID_ARGUMENT if the
// folder cannot be used, or if another server uses it. DATA_LOSS if nothing of a damaged file can
// be read.
absl::StatusOr<std::unique_ptr<JournalBackend>> OpenFileBackend(
    const std::string& directory, absl::Duration retention,
    std::function<absl::Time()> now = absl::Now, const Clock* clock = nullptr,
    const JournalVisitor& visitor = {});

}  // namespace spikeserve
