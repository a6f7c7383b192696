#include "server/usage/local_usage_store.h"

#include <fcntl.h>
#include <sys/file.h>

#include <algorithm>
#include <filesystem>
#include <system_error>
#include <utility>

#include "absl/strings/match.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_split.h"
#include "absl/strings/strip.h"
#include "core/base/status_macros.h"
#include "server/base/log.h"

namespace spikeserve {
namespace {

constexpr char kLedgerTable[] = "ledger";
constexpr char kSessionPrefix[] = "s/";
constexpr size_t kMostBytes = size_t{4} << 30;

std::string LocalMonthKey(absl::Time time) {
  return absl::FormatTime("t/%Y%m/", time, absl::UTCTimeZone());
}

// The time in seconds, and the totals.
std::string FormatTotals(absl::Time time, const UsageTotals& totals) {
  std::string text = absl::StrCat(absl::ToUnixSeconds(time));
  for (const double value : totals) absl::StrAppendFormat(&text, " %.17g", value);
  return text;
}

void ParseTotals(absl::string_view text, int64_t* seconds, UsageTotals* totals) {
  const std::vector<absl::string_view> parts = absl::StrSplit(text, ' ');
  if (parts.size() != totals->size() + 1 || !absl::SimpleAtoi(parts[0], seconds)) return;
  for (size_t i = 0; i < totals->size(); ++i) {
    if (!absl::SimpleAtod(parts[i + 1], &(*totals)[i])) (*totals)[i] = 0.0;
  }
}

// Returns the part that a key belongs to; empty: none.
absl::string_view PartOf(absl::string_view key) {
  const absl::string_view name = key.substr(0, key.find('/'));
  return SpanOf(name).has_value() ? name : absl::string_view();
}

}  // namespace

absl::StatusOr<std::unique_ptr<LocalUsageStore>> LocalUsageStore::Open(
    const std::string& directory) {
  auto store = std::unique_ptr<LocalUsageStore>(new LocalUsageStore());
  if (directory.empty()) return store;
  std::error_code error;
  std::filesystem::create_directories(directory, error);
  store->lock_ = FileDescriptor(open(directory.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC));
  if (!store->lock_.valid() || flock(store->lock_.get(), LOCK_EX | LOCK_NB) != 0) {
    return absl::InvalidArgumentError(
        absl::StrCat("expected a writable folder that no other server uses, received ", directory));
  }
  auto status = store->Load(directory);
  if (absl::IsDataLoss(status)) {
    const std::string file = absl::StrCat(directory, "/data.mdb");
    LogError("ledger is damaged; begins with an empty one",
             {{"kept_as", absl::StrCat(file, ".damaged")}, {"error", status.message()}});
    std::filesystem::rename(file, absl::StrCat(file, ".damaged"), error);
    status = store->Load(directory);
  }
  if (status.ok()) return store;
  return absl::InvalidArgumentError(
      absl::StrCat("expected a writable folder, received ", directory, ": ", status.message()));
}

absl::Status LocalUsageStore::Load(const std::string& directory) {
  absl::MutexLock lock(&mutex_);
  environment_ = nullptr;
  table_.clear();
  ASSIGN_OR_RETURN(environment_, OpenLmdb(directory, kMostBytes));
  ASSIGN_OR_RETURN(auto transaction, LmdbTransaction::Begin(environment_.get()));
  ASSIGN_OR_RETURN(const MDB_dbi records, transaction.OpenTable(kLedgerTable));
  records_ = records;
  RETURN_IF_ERROR(
      transaction.Scan(records, "", [&](absl::string_view key, absl::string_view value) {
        mutex_.AssertHeld();
        Set(std::string(key), std::string(value));
      }));
  changed_.clear();
  return transaction.Commit();
}

void LocalUsageStore::Set(const std::string& key, std::string value) {
  const auto [at, is_new] = table_.insert_or_assign(key, std::move(value));
  changed_.insert(key);
  const std::string part(PartOf(key));
  if (part.empty()) return;
  ++revisions_[part];
  if (is_new && part[0] == 'o') ++series_[part];
}

void LocalUsageStore::Remove(const std::string& key) {
  table_.erase(key);
  changed_.insert(key);
}

void LocalUsageStore::Add(const std::string& key, const UsageCounts& counts) {
  const auto found = table_.find(key);
  UsageCounts sum = found == table_.end() ? UsageCounts() : ParseCounts(found->second);
  sum += counts;
  Set(key, FormatCounts(sum));
}

void LocalUsageStore::BookTotals(const UsageBatch& batch, const SessionTotals& session,
                                 std::map<std::string, UsageCounts>* added) {
  const std::string key = absl::StrCat(kSessionPrefix, session.session);
  int64_t seconds = 0;
  UsageTotals booked = {};
  if (const auto found = table_.find(key); found != table_.end()) {
    ParseTotals(found->second, &seconds, &booked);
  }
  UsageCounts& counts = (*added)[session.series];
  for (size_t i = 0; i < booked.size(); ++i) {
    const double more = std::max(0.0, session.totals[i] - booked[i]);
    counts.values[i] += more;
    booked[i] = std::max(booked[i], session.totals[i]);
  }
  Set(key, FormatTotals(batch.time, booked));
}

double LocalUsageStore::BookedDecisions(const std::string& session) {
  absl::MutexLock lock(&mutex_);
  int64_t seconds = 0;
  UsageTotals booked = {};
  if (const auto found = table_.find(absl::StrCat(kSessionPrefix, session));
      found != table_.end()) {
    ParseTotals(found->second, &seconds, &booked);
  }
  return booked[0];
}

absl::Status LocalUsageStore::Book(const UsageBatch& batch) {
  absl::MutexLock lock(&mutex_);
  std::map<std::string, UsageCounts> added = batch.added;
  for (const SessionTotals& session : batch.totals) BookTotals(batch, session, &added);
  const std::string part = OpenPart(batch.time);
  for (const auto& [series, counts] : added) {
    const bool fits =
        series_[part] < kMostSeries || table_.contains(absl::StrCat(part, "/", series));
    Add(absl::StrCat(part, "/", fits ? series : OtherSeries(series)), counts);
    Add(absl::StrCat(LocalMonthKey(batch.time), UsageSeries::FromKey(series).tenant), counts);
  }
  if (auto status = Flush(); !status.ok()) {
    LogWarning("ledger not written; tries again", {{"error", status.message()}});
  }
  return absl::OkStatus();
}

absl::Status LocalUsageStore::Flush() {
  if (environment_ == nullptr) {
    changed_.clear();
    return absl::OkStatus();
  }
  ASSIGN_OR_RETURN(auto transaction, LmdbTransaction::Begin(environment_.get()));
  for (const std::string& key : changed_) {
    const auto found = table_.find(key);
    RETURN_IF_ERROR(found == table_.end() ? transaction.Delete(records_, key)
                                          : transaction.Put(records_, key, found->second));
  }
  RETURN_IF_ERROR(transaction.Commit());
  changed_.clear();
  return absl::OkStatus();
}

absl::StatusOr<std::map<std::string, UsageCounts>> LocalUsageStore::MonthOf(absl::Time time) {
  absl::MutexLock lock(&mutex_);
  std::map<std::string, UsageCounts> tenants;
  const std::string month = LocalMonthKey(time);
  for (auto at = table_.lower_bound(month); at != table_.end(); ++at) {
    absl::string_view tenant = at->first;
    if (!absl::ConsumePrefix(&tenant, month)) break;
    tenants[std::string(tenant)] = ParseCounts(at->second);
  }
  return tenants;
}

absl::StatusOr<std::vector<std::string>> LocalUsageStore::Parts() {
  absl::MutexLock lock(&mutex_);
  std::vector<std::string> names;
  for (const auto& [part, revision] : revisions_) names.push_back(part);
  return names;
}

std::string LocalUsageStore::RevisionOf(const std::string& part) const {
  const auto found = revisions_.find(part);
  return found == revisions_.end() ? "" : absl::StrCat(found->second);
}

absl::StatusOr<UsagePart> LocalUsageStore::Read(const std::string& part) {
  UsagePart read = {.name = part};
  std::string packed;
  {
    absl::MutexLock lock(&mutex_);
    read.revision = RevisionOf(part);
    if (const auto found = table_.find(part); found != table_.end()) packed = found->second;
    const std::string prefix = absl::StrCat(part, "/");
    const auto span = SpanOf(part);
    for (auto at = table_.lower_bound(prefix); at != table_.end() && span.has_value(); ++at) {
      absl::string_view series = at->first;
      if (!absl::ConsumePrefix(&series, prefix)) break;
      read.rows.push_back({.series = std::string(series),
                           .hour = absl::ToInt64Hours(span->first - absl::UnixEpoch()),
                           .counts = ParseCounts(at->second)});
    }
  }
  if (packed.empty()) return read;
  ASSIGN_OR_RETURN(read.rows, UnpackRows(packed));
  return read;
}

absl::Status LocalUsageStore::Replace(const UsagePart& source, const UsagePart& target,
                                      const std::string& packed) {
  absl::MutexLock lock(&mutex_);
  if (RevisionOf(source.name) != source.revision || RevisionOf(target.name) != target.revision) {
    return absl::OkStatus();
  }
  Set(target.name, packed);
  for (const UsageRow& row : source.rows) Remove(absl::StrCat(source.name, "/", row.series));
  Remove(source.name);
  revisions_.erase(source.name);
  series_.erase(source.name);
  return Flush();
}

absl::Status LocalUsageStore::Forget(absl::Time time) {
  absl::MutexLock lock(&mutex_);
  std::vector<std::string> old;
  for (auto at = table_.lower_bound(kSessionPrefix);
       at != table_.end() && absl::StartsWith(at->first, kSessionPrefix); ++at) {
    int64_t seconds = 0;
    UsageTotals totals;
    ParseTotals(at->second, &seconds, &totals);
    if (seconds < absl::ToUnixSeconds(time)) old.push_back(at->first);
  }
  for (const std::string& key : old) Remove(key);
  return Flush();
}

}  // namespace spikeserve
