// What an answer waits for before it is sent: the records of its sessions that the store must
// acknowledge, and a contribution that the head of a fleet must take. SessionGate waits for them.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <cstdint>
#include <memory>

#include "absl/base/thread_annotations.h"
#include "absl/container/inlined_vector.h"
#include "absl/status/status.h"
#include "core/agent/head_log.h"
#include "core/journal/session_journal.h"
#include "core/open_sessions/session_store.h"

namespace spikeserve {

// A position in the journal of a session.
struct Commit {
  std::shared_ptr<SessionJournal> journal;
  uint64_t position = 0;
  int item = -1;  // index of the item of a batch that waits; -1: the whole answer waits
  // Awaited after the journal, because its outcome is part of the answer; null: none.
  std::shared_ptr<FleetContribution> contribution = nullptr;
  // The answer says that the session is open. If the store refuses that, the session is withdrawn.
  bool opens = false;
};
// Empty, and without memory of its own, unless a session is stored.
using Commits = absl::InlinedVector<Commit, 1>;

// The functions below are called under the session's lock, so that an answer waits for what it
// tells.

// Waits for everything that was written to the session's journal, whatever its durability is.
void AddStored(const SessionEntry& entry, Commits* commits);

// Adds what an answer about the session must wait for. An operator is heard only in what the store
// has: the next owner of the session would go on with the operator before, who was relieved.
void AddCommit(const SessionEntry& entry, Commits* commits) ABSL_SHARED_LOCKS_REQUIRED(entry.mutex);

// As AddCommit, for requests that do not name their decision: whatever the durability is, also
// waits until the store confirms that this server still owns the session, with the last decision or
// with a query of its own.
// Does nothing more than AddCommit if no other server uses the store.
void AddConfirmation(const SessionEntry& entry, bool has_decided, Commits* commits)
    ABSL_SHARED_LOCKS_REQUIRED(entry.mutex);

// Returns UNAVAILABLE if an operator has control whom no answer may tell of, because the store
// cannot be reached. The lease ends by itself.
absl::Status CheckMayBeHeard(const SessionEntry& entry) ABSL_SHARED_LOCKS_REQUIRED(entry.mutex);

}  // namespace spikeserve
