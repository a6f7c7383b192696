// Records with a checksum, so that bytes which a disk has changed are found.
//
//   put(SealRecord(record));
//   records.push_back(OpenRecord(get()));
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns `record` with its checksum behind it.
std::string SealRecord(absl::string_view record);

// Returns the record without its checksum, or an empty string if the checksum is wrong:
// ParseJournal refuses an empty record. Returns bytes without a checksum unchanged: earlier
// releases wrote none, and ParseJournal refuses a record whose checksum is unrecognizable.
std::string OpenRecord(absl::string_view bytes);

// Returns a record whose checksum is wrong, for the place of one that is lost.
std::string DamagedRecord();

// Removes empty records from the end of a journal, behind its first record. Their decisions may be
// sent again. Returns DATA_LOSS, which names the first one, or OK if there is none.
absl::Status CutDamagedEnd(std::vector<std::string>* journal);

}  // namespace spikeserve
