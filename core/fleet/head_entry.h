// Defines the entries of the log of a policy version's heads, and their binary form (CBOR).
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <array>
#include <cstdint>
#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/base/enum_names.h"
#include "core/learning/contribution.h"

namespace spikeserve {

struct HeadEntry {
  enum class Kind { kMerge, kRollback, kPause, kResume, kUndo };

  Kind kind = Kind::kMerge;
  // kRollback has only the head, and kPause and kResume, which change all heads, not even that.
  // kUndo has the operator as `operators`, and the seconds as `episode_return`. A random name is
  // the session of them all. The log has each session and episode once. The server of the
  // session decides whether it is held out, so that all servers agree.
  Contribution contribution = {};
};

constexpr std::array<EnumName<HeadEntry::Kind>, 5> EnumNames(HeadEntry::Kind) {
  return {{{HeadEntry::Kind::kMerge, "merge"},
           {HeadEntry::Kind::kRollback, "rollback"},
           {HeadEntry::Kind::kPause, "pause"},
           {HeadEntry::Kind::kResume, "resume"},
           {HeadEntry::Kind::kUndo, "undo"}}};
}

std::string SerializeHeadEntry(const HeadEntry& entry);
// Returns the bytes with which the forms of all entries of this kind, session and episode begin,
// and no others.
std::string HeadEntryIdentity(const HeadEntry& entry);
// Converts the bytes back to an entry that is equal bit for bit. INVALID_ARGUMENT if `bytes` is not
// such a form.
absl::StatusOr<HeadEntry> ParseHeadEntry(const std::string& bytes);

// A place in the log. The digest is that of all entries up to this one.
struct HeadPosition {
  std::string id = "0-0";  // of the stream: milliseconds of the clock of Redis, and a counter
  int64_t number = 0;      // of the entry, from 1; 0: before the first
  std::string digest;      // empty before the first

  friend bool operator==(const HeadPosition&, const HeadPosition&) = default;
};

// An entry as the log has it.
struct LoggedEntry {
  HeadPosition position;
  int64_t members = 0;  // contributors with a session on any server; see FleetHead::Merge()
  std::string bytes;    // of SerializeHeadEntry()
};

// Returns the digest of the position at which `entry` follows one with the digest `before`.
std::string NextDigest(absl::string_view before, const LoggedEntry& entry);

}  // namespace spikeserve
