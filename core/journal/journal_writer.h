// Defines where the journals of sessions are written.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/time/time.h"

namespace spikeserve {

class SessionJournal;

// One write to the journal of a session.
struct JournalRecord {
  enum class Kind {
    kOpen,      // a snapshot that starts the journal; ALREADY_EXISTS if there is one
    kEntry,     // adds an entry
    kSnapshot,  // adds a snapshot, which replaces everything before it
    kRelease,   // adds a snapshot, and gives the session up: the server stops
    kClose,     // ends the session: its journal is deleted
    kConfirm,   // writes nothing: asks whether the writer still owns the journal
  };

  Kind kind = Kind::kEntry;
  std::string bytes;       // empty for kClose and kConfirm
  uint64_t decisions = 0;  // of the session, with this record
  int64_t episodes = 0;    // that have ended, likewise
  uint64_t changes = 0;    // Session::changes(), likewise
  size_t records = 0;      // of the journal in the store, with this one
  uint64_t position = 0;   // of the record in all that its owner writes, from 1
  uint64_t base = 0;       // position of the snapshot that the journal begins with; 0: claimed
  std::shared_ptr<SessionJournal> journal;
  absl::Duration queued = {};  // when the writer has queued it, by its clock
};

// Implementations are thread-safe.
class JournalWriter {
 public:
  virtual ~JournalWriter() = default;

  // Queues a record and returns at once. Records of one journal are written in the order of the
  // calls. Their outcomes go to SessionJournal::OnWritten(), on another thread.
  virtual void Write(JournalRecord record) = 0;

  // Lets the records in the queue be written now, because an answer waits for one of them. Without
  // it they may wait a few milliseconds for others.
  virtual void Hurry() = 0;

  // Returns UNAVAILABLE while the store cannot be reached.
  virtual absl::Status CheckReachable() const = 0;
  // Returns UNAVAILABLE while the queue is full.
  virtual absl::Status CheckBacklog() const = 0;
  // Returns FAILED_PRECONDITION if the store may remove what it has acknowledged.
  virtual absl::Status CheckKeepsRecords() const { return absl::OkStatus(); }
  // Returns whether other processes may claim the sessions of this one.
  virtual bool IsShared() const { return false; }
};

}  // namespace spikeserve
