// What the ledger of usage counts. Plain values.
#pragma once

#include <array>
#include <cstddef>

#include "core/base/enum_names.h"

namespace spikeserve {

// In the order in which they are stored, to which later releases may append.
enum class UsageField {
  // Totals of the value of a session, which its journal has.
  kDecisions,
  kSpikes,
  kHorowitz45nm,  // joules, as the next two
  kInt45nm,
  kIntSram45nm,
  kFresh,  // steps by source, as robots report them
  kHeld,
  kLocal,
  kSafe,
  kSessionSeconds,
  kBytes,
  kRefusedCalls,
  kContributions,
  kSessions,
};
// The energy models of the ledger, whose fields have their names.
inline constexpr UsageField kJoulesFields[] = {UsageField::kHorowitz45nm, UsageField::kInt45nm,
                                               UsageField::kIntSram45nm};
inline constexpr size_t kUsageFields = 14;
inline constexpr size_t kJournalFields = 3;  // the first ones

constexpr std::array<EnumName<UsageField>, kUsageFields> EnumNames(UsageField) {
  return {{{UsageField::kDecisions, "decisions"},
           {UsageField::kSpikes, "spikes"},
           {UsageField::kHorowitz45nm, "horowitz_45nm"},
           {UsageField::kInt45nm, "int_45nm"},
           {UsageField::kIntSram45nm, "int_sram_45nm"},
           {UsageField::kFresh, "fresh"},
           {UsageField::kHeld, "held"},
           {UsageField::kLocal, "local"},
           {UsageField::kSafe, "safe"},
           {UsageField::kSessionSeconds, "session_seconds"},
           {UsageField::kBytes, "bytes"},
           {UsageField::kRefusedCalls, "refused_calls"},
           {UsageField::kContributions, "contributions"},
           {UsageField::kSessions, "sessions"}}};
}

// One number for each field; integers are exact up to 2^53.
struct UsageCounts {
  std::array<double, kUsageFields> values = {};

  double& operator[](UsageField field) { return values[static_cast<size_t>(field)]; }
  double operator[](UsageField field) const { return values[static_cast<size_t>(field)]; }
  UsageCounts& operator+=(const UsageCounts& other) {
    for (size_t i = 0; i < kUsageFields; ++i) values[i] += other.values[i];
    return *this;
  }

  friend bool operator==(const UsageCounts&, const UsageCounts&) = default;
};

// The first fields, over the life of a session.
using UsageTotals = std::array<double, kJournalFields>;

// What the ledger remembers of a session. Guarded by the session's lock.
struct SessionUsage {
  UsageCounts booked;          // of what this process has counted
  UsageTotals totals = {};     // that were booked last
  UsageTotals seen = {};       // totals at the last look, which may not be stored yet
  double seen_changes = -1.0;  // Session::changes() then; negative: not looked at yet
  double booked_at = 0.0;      // seconds of the clock
  bool is_closed = false;      // all but the contributions is booked
};

}  // namespace spikeserve
