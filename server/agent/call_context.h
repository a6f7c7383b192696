// What the handler of a request knows of the call beside its message, and what it leaves to the
// call. Every method of every handler has one form:
//
//   absl::Status Method(CallContext& context, const Request& request, Response* response) const;
//
// Not thread-safe: belongs to one request, whose handler has it for itself until it returns.
#pragma once

#include <cstdint>
#include <memory>

#include "absl/container/inlined_vector.h"
#include "core/agent/head_log.h"
#include "core/journal/session_journal.h"
#include "core/open_sessions/session_store.h"
#include "server/access/authenticator.h"
#include "server/base/peer.h"
#include "server/trace/span.h"

namespace spikeserve {

class DeferredWork;

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

struct CallContext {
  const Credential* caller = nullptr;  // never null for a handler; outlives the request
  bool is_datagram = false;            // the request came as one
  // The first decision was counted at the tenant's rate when the caller was admitted.
  bool has_paid = false;
  // Set for methods whose calls are recorded in the audit log.
  Peer peer = {};
  // Receives what is done after the answer was sent. Null for methods that defer nothing.
  DeferredWork* deferred = nullptr;
  // Gathers what the answer must wait for (session_gate.h). Callers that send no answer ignore it.
  Commits commits = {};
  // True: a request that is ahead of a stored session gets NOT_FOUND and makes this copy lost, so
  // that the session is claimed again. Another server may have decided in between.
  bool may_claim = false;
  // The store has had the session for this request, and this server has taken it over.
  bool has_claimed = false;
  // The session of a request that only reads, if this server does not hold it: as the store has it.
  // It stays with its owner. Null: none was read.
  std::shared_ptr<SessionEntry> read = nullptr;
  // Of the request; empty if it is not traced. Spans of its parts belong to it.
  Span span = {};
};

}  // namespace spikeserve
