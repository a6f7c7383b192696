// Where journals are kept: what a JournalStore writes to and reads from.
#ifndef SERVER_STORE_JOURNAL_BACKEND_H_
#define SERVER_STORE_JOURNAL_BACKEND_H_

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/session/journal_writer.h"

namespace spikeserve {

// Names the session that a server claims.
struct JournalClaim {
  std::string id;
  std::string tenant;
  std::vector<std::string> policy_files;  // that the server has; see SessionJournal::Key
};

// The journal of a session at the moment at which it was claimed.
struct ClaimedJournal {
  // Of the new owner; 0: the session was left to its owner, because the server lacks its policy.
  uint64_t epoch = 0;
  // In the order in which they were written. If the session was left, the first one only.
  std::vector<std::string> records;
};

// Called by one thread. The methods may block.
class JournalBackend {
 public:
  virtual ~JournalBackend() = default;

  // Writes `records` in their order. Returns their outcomes: OK, ABORTED if the writer does not own
  // the journal any more, ALREADY_EXISTS, or NOT_FOUND if the store has lost the journal or a part
  // of it. Returns UNAVAILABLE if the store cannot be reached. Then some of the records may have
  // been written, or may be written later, and all are to be passed to the next call again.
  virtual absl::StatusOr<std::vector<absl::Status>> Write(
      absl::Span<const JournalRecord> records) = 0;

  // Makes the caller the owner of the journals of sessions and returns them, in the order of
  // `claims`. NOT_FOUND: the store has no open session with this id and tenant. UNAVAILABLE, for
  // all claims: the store cannot be reached. A store that several servers use leaves a session to
  // its owner if the caller lacks its policy file.
  virtual std::vector<absl::StatusOr<ClaimedJournal>> Claim(
      absl::Span<const JournalClaim> claims) = 0;
};

}  // namespace spikeserve

#endif  // SERVER_STORE_JOURNAL_BACKEND_H_
