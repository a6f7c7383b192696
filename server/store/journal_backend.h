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

// The journal of a session at the moment at which it was claimed.
struct ClaimedJournal {
  uint64_t epoch = 0;                // of the new owner
  std::vector<std::string> records;  // in the order in which they were written
};

// Called by one thread. The methods may block.
class JournalBackend {
 public:
  virtual ~JournalBackend() = default;

  // Writes `records` in their order. Returns their outcomes: OK, ABORTED if the writer does not own
  // the journal any more, or ALREADY_EXISTS. Returns UNAVAILABLE if the store cannot be reached.
  // Then some of the records may have been written, and all are to be written again later.
  virtual absl::StatusOr<std::vector<absl::Status>> Write(
      absl::Span<const JournalRecord> records) = 0;

  // Makes the caller the owner of a session's journal and returns it. Returns NOT_FOUND if the
  // store has no open session with this id and tenant, and UNAVAILABLE as above.
  virtual absl::StatusOr<ClaimedJournal> Claim(const std::string& id,
                                               const std::string& tenant) = 0;
};

}  // namespace spikeserve

#endif  // SERVER_STORE_JOURNAL_BACKEND_H_
