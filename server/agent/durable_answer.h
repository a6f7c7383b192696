// What an answer waits for before it is sent: the records of its sessions that the store must
// acknowledge, and a contribution that the head of a fleet must take. SessionGate waits for them.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <cstdint>
#include <memory>

#include "absl/container/inlined_vector.h"
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

// Adds what an answer about the session must wait for: everything that was written to its journal,
// if its durability is SYNC. Call it under the session's lock, so that it is what the answer tells.
void AddCommit(const SessionEntry& entry, Commits* commits);

// As AddCommit, for requests that do not name their decision: whatever the durability is, also
// waits until the store confirms that this server still owns the session, with the last decision or
// with a query of its own.
// Does nothing more than AddCommit if no other server uses the store.
void AddConfirmation(const SessionEntry& entry, bool has_decided, Commits* commits);

}  // namespace spikeserve
