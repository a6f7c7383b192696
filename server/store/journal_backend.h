// Where journals are kept: what a JournalStore writes to and reads from.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/journal/journal_writer.h"

namespace spikeserve {

// Names the session that a server claims.
struct JournalClaim {
  std::string id;
  std::string tenant;
  // Returns whether the server has a policy file; see SessionJournal::Key. Null: it has all.
  std::function<bool(const std::string& policy_file)> has_policy = nullptr;
  bool only_reads = false;  // the session stays with its owner
};

// The journal of a session at the moment at which it was claimed.
struct ClaimedJournal {
  // Of the new owner; 0: the session was left to its owner, because the server lacks its policy or
  // only reads.
  uint64_t epoch = 0;
  // In the order in which they were written. If the server lacks the policy, the first one only.
  std::vector<std::string> records;
  uint64_t claimed_from = 0;   // epoch of the owner before; 0: unknown
  std::string stored_as = "";  // as SessionJournal::Key::stored_as
};

// A journal whose owner is this server, and whether its session was used lately.
struct HeldJournal {
  std::shared_ptr<SessionJournal> journal;
  bool is_used = false;
};

// Called by one thread. The methods may block.
class JournalBackend {
 public:
  virtual ~JournalBackend() = default;

  // Returns whether several servers use the store, so that it may give a session to another one.
  virtual bool IsShared() const { return false; }

  // Returns the sessions in the store; absent: only a search would tell. Safe to call from many
  // threads.
  virtual std::optional<int64_t> StoredSessions() const { return std::nullopt; }

  using Visit = std::function<void(const std::string& id, const std::vector<std::string>& records)>;
  // Calls `visit` with the first snapshot, at least, of each open session that no other living
  // server has: it may be the caller's own. Safe to call from many threads. Returns UNAVAILABLE if
  // the store cannot be read.
  virtual absl::Status VisitUnowned(const Visit&) { return absl::OkStatus(); }

  // Makes sure that the store can be reached. Returns true if it may have lost something since the
  // last call, because there was another connection: then Check() is to be called for all journals
  // before anything is written or claimed. Returns UNAVAILABLE if it cannot be reached.
  virtual absl::StatusOr<bool> Connect() { return false; }

  // Returns FAILED_PRECONDITION if the store may remove records that it has acknowledged.
  virtual absl::Status CheckKeepsRecords() const { return absl::OkStatus(); }

  // Compares journals with SessionJournal::stored(), and prolongs the time that the store keeps
  // those that are used. Returns their outcomes: OK, ABORTED or NOT_FOUND, as for Write(), or
  // UNAVAILABLE if the store does not tell now. Returns UNAVAILABLE if it cannot be reached.
  virtual absl::StatusOr<std::vector<absl::Status>> Check(absl::Span<const HeldJournal> journals) {
    return std::vector<absl::Status>(journals.size());
  }

  // Writes `records` in their order. Returns their outcomes: OK, ABORTED if the writer does not own
  // the journal any more, ALREADY_EXISTS, or NOT_FOUND if the store has lost the journal or a part
  // of it. Returns UNAVAILABLE if the store cannot be reached. Then some of the records may have
  // been written, or may be written later, and all are to be passed to the next call again. The
  // outcome UNAVAILABLE of single records: the store does not take them at present, and they are to
  // be passed again, before later ones of their journals.
  virtual absl::StatusOr<std::vector<absl::Status>> Write(
      absl::Span<const JournalRecord> records) = 0;

  // Makes the caller the owner of the journals of sessions and returns them, in the order of
  // `claims`. NOT_FOUND: the store has no open session with this id and tenant; with the mark of
  // lost_session.h if several servers use it and it does not know of an end either. UNAVAILABLE:
  // the store cannot be reached, or cannot give the session away now. A store that several servers
  // use leaves a session to its owner if the caller lacks its policy file or only reads.
  virtual std::vector<absl::StatusOr<ClaimedJournal>> Claim(
      absl::Span<const JournalClaim> claims) = 0;
};

}  // namespace spikeserve
