#include "server/usage/usage_store.h"

#include <utility>

#include "core/base/status_macros.h"

namespace spikeserve {

absl::StatusOr<std::vector<UsageRow>> ReadUsage(UsageStore& store, absl::Time from, absl::Time to) {
  constexpr int kTries = 5;
  ASSIGN_OR_RETURN(auto names, store.Parts());
  for (int i = 0; i < kTries; ++i) {
    std::vector<UsageRow> rows;
    for (const std::string& name : names) {
      const auto span = SpanOf(name);
      if (!span.has_value() || span->second <= from || span->first >= to) continue;
      ASSIGN_OR_RETURN(auto part, store.Read(name));
      for (UsageRow& row : part.rows) {
        const absl::Time begin = absl::UnixEpoch() + absl::Hours(row.hour);
        if (begin >= from && begin < to) rows.push_back(std::move(row));
      }
    }
    // Rows that were moved meanwhile were read twice, or not at all.
    ASSIGN_OR_RETURN(auto after, store.Parts());
    if (after == names) return rows;
    names = std::move(after);
  }
  return absl::UnavailableError("ledger: its parts are being moved; try again");
}

absl::Status CompactUsage(UsageStore& store, absl::Time now) {
  ASSIGN_OR_RETURN(const auto names, store.Parts());
  for (const std::string& name : names) {
    const auto target_name = TargetOf(name, now);
    if (!target_name.has_value()) continue;
    ASSIGN_OR_RETURN(const auto source, store.Read(name));
    ASSIGN_OR_RETURN(const auto target, store.Read(*target_name));
    UsageRows rows;
    Merge(*target_name, target.rows, &rows);
    Merge(*target_name, source.rows, &rows);
    RETURN_IF_ERROR(store.Replace(source, target, PackRows(rows)));
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
