// Defines what a session's journal stores, and restores a session from it.
//
// A journal is a list of records: snapshots, which are whole sessions (session.h), and entries, one
// for each decision since. Each record is a CBOR document that begins with the name of its format.
// An entry holds the decision as it was answered. Therefore a session is restored without its
// engine, and continues from the same answers even in a release whose engine would decide
// otherwise.
//
//   auto journal = ParseJournal(records);
//   auto session = RestoreSession(*std::move(journal), policy);
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "core/model/policy.h"
#include "core/session/session.h"

namespace spikeserve {

// One decision. `Floats` is a vector or a span, and `AnswerType` a value or a reference, so that an
// entry is written without copies.
template <typename Floats, typename AnswerType>
struct BasicJournalEntry {
  uint64_t decision = 0;  // number of the decision in the session, from 0
  double reward = 0.0;    // that the decision counted; 0 at step 0
  Floats observation;     // [obs]
  // The action that was executed at the previous step, if the agent reported it.
  std::optional<Action> executed;
  AnswerType answer;
  // Sessions that learn only:
  Floats readout;          // [d]: input of the action head
  Floats noise;            // as ActionChoice::noise
  bool suspended = false;  // learning was paused in this episode
};
using JournalEntry = BasicJournalEntry<std::vector<float>, Answer>;
using JournalEntryView = BasicJournalEntry<absl::Span<const float>, const Answer&>;

std::string SerializeEntry(const JournalEntryView& entry);
// Converts the bytes back to an entry that is equal bit for bit. INVALID_ARGUMENT if `bytes` is not
// such a form.
absl::StatusOr<JournalEntry> ParseEntry(const std::string& bytes);

// A snapshot and the entries that were written after it.
struct Journal {
  Session snapshot;
  std::vector<JournalEntry> entries;
  size_t after_gap = 0;  // records that were ignored, because a decision before them is missing
};

// Parses the records of a journal, in the order in which they were written. Starts at the last
// snapshot, and ends before the first gap: a store that has lost its last writes may have taken a
// record since, whose writer then found out and was not acknowledged. Returns DATA_LOSS, which
// names the record, if there is no snapshot or a record after it is damaged.
absl::StatusOr<Journal> ParseJournal(absl::Span<const std::string> records);

// Returns the session after the last entry, bit for bit as it was. Ignores entries that the
// snapshot, or an earlier entry, contains. Returns DATA_LOSS if an entry does not follow the one
// before or does not belong to a session of `policy`.
absl::StatusOr<Session> RestoreSession(Journal journal, const Policy& policy);

}  // namespace spikeserve
