// The rows of the ledger: what a series has used in an hour, a day or a month; and how rows lie in
// a store.
//
//   const std::string bytes = PackRows(rows);
//   ASSIGN_OR_RETURN(const std::vector<UsageRow> again, UnpackRows(bytes));
//
// Plain values, and free functions without shared state; safe to call from many threads.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "core/session/session.h"
#include "core/session/usage.h"

namespace spikeserve {

// What is counted together.
struct UsageSeries {
  std::string tenant = "";
  std::string policy = "";  // empty: what is known of the tenant alone
  int64_t version = 0;
  std::string label = "";  // value of the session's label --usage_label

  // Returns the four parts, shortened to 150 bytes each, with a byte between them that UTF-8 does
  // not have.
  std::string ToKey() const;
  static UsageSeries FromKey(absl::string_view key);
};

// `label` is the key of the label that distinguishes series; empty: none does.
UsageSeries SeriesOf(const SessionOptions& options, const std::string& label);

// Returns the key of the series of the same tenant that takes what is beyond the most series.
std::string OtherSeries(absl::string_view key);

struct UsageRow {
  std::string series;  // UsageSeries::ToKey()
  int64_t hour = 0;    // the first one, since 1970 in UTC
  UsageCounts counts = {};
};

// By series and hour.
using UsageRows = std::map<std::pair<std::string, int64_t>, UsageCounts>;

// Most series in one hour, day or month. What is beyond goes to OtherSeries().
inline constexpr size_t kMostSeries = 20'000;

// Numbers separated by spaces, exact.
std::string FormatCounts(const UsageCounts& counts);
UsageCounts ParseCounts(absl::string_view text);  // 0 for what is missing

// Packs rows, compressed: joules to 0.1 nJ, seconds to 1 ms. Rows of a series have spikes, joules,
// seconds and bytes to 1/2048 of its largest row; their sum over all rows loses nothing.
std::string PackRows(const UsageRows& rows);
// DATA_LOSS if `bytes` are not those of PackRows().
absl::StatusOr<std::vector<UsageRow>> UnpackRows(absl::string_view bytes);

// The parts of the ledger, by name: `o` with an hour is open, to which more is added; `h` with a
// day has rows by hour, `d` with a month by day, and `m` with a year by month.
std::string OpenPart(absl::Time time);
// Returns the part that takes the rows of `part`, once that is over: an hour after 5 minutes, the
// hours of a day after 35 days, the days of a month after 13 months. Nullopt: none does yet.
std::optional<std::string> TargetOf(absl::string_view part, absl::Time now);
// Returns the first hour of the row that takes what was used in `hour`, in the part `target`.
int64_t Truncate(absl::string_view target, int64_t hour);
// Returns the time that a part is about: from the first to before the second one. Nullopt: it is no
// name of a part.
std::optional<std::pair<absl::Time, absl::Time>> SpanOf(absl::string_view part);

// Adds `more` to `rows`, as rows of `target`, of at most kMostSeries series in each.
void Merge(absl::string_view target, const std::vector<UsageRow>& more, UsageRows* rows);

}  // namespace spikeserve
