#include <fcntl.h>
#include <sys/file.h>

#include <algorithm>
#include <filesystem>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <system_error>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/status/statusor.h"
#include "absl/strings/match.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_split.h"
#include "absl/strings/strip.h"
#include "absl/synchronization/mutex.h"
#include "core/base/status_macros.h"
#include "core/store/lmdb.h"
#include "server/base/file_descriptor.h"
#include "server/base/log.h"
#include "server/usage/usage_store.h"

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

std::pair<int64_t, UsageTotals> ParseTotals(absl::string_view text) {
  std::pair<int64_t, UsageTotals> parsed = {};
  auto& [seconds, totals] = parsed;
  const std::vector<absl::string_view> parts = absl::StrSplit(text, ' ');
  if (parts.size() != totals.size() + 1 || !absl::SimpleAtoi(parts[0], &seconds)) return parsed;
  for (size_t i = 0; i < totals.size(); ++i) {
    if (!absl::SimpleAtod(parts[i + 1], &totals[i])) totals[i] = 0.0;
  }
  return parsed;
}

// Returns the part that a key belongs to; empty: none.
absl::string_view PartOf(absl::string_view key) {
  const absl::string_view name = key.substr(0, key.find('/'));
  return SpanOf(name).has_value() ? name : absl::string_view();
}

class LocalStore final : public LocalUsageStore {
 public:
  explicit LocalStore(const Clock* clock) : clock_(*clock), opened_(clock->Now()) {}

  // Locks and reads the folder.
  absl::Status OpenFolder(const std::string& directory) {
    std::error_code error;
    std::filesystem::create_directories(directory, error);
    lock_ = FileDescriptor(open(directory.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC));
    if (!lock_.valid() || flock(lock_.get(), LOCK_EX | LOCK_NB) != 0) {
      return absl::InvalidArgumentError(absl::StrCat(
          "expected a writable folder that no other server uses, received ", directory));
    }
    auto status = Load(directory);
    if (absl::IsDataLoss(status)) {
      const std::string file = absl::StrCat(directory, "/data.mdb");
      LogError("ledger is damaged; begins with an empty one",
               {{"kept_as", absl::StrCat(file, ".damaged")}, {"error", status.message()}});
      std::filesystem::rename(file, absl::StrCat(file, ".damaged"), error);
      status = Load(directory);
    }
    if (status.ok()) return status;
    return absl::InvalidArgumentError(
        absl::StrCat("expected a writable folder, received ", directory, ": ", status.message()));
  }

  double BookedDecisions(const std::string& session) override ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    return BookedTotals(absl::StrCat(kSessionPrefix, session))[0];
  }

  absl::Status Book(const UsageBatch& batch) override {
    absl::MutexLock lock(&mutex_);
    std::map<std::string, UsageCounts> added = batch.added;
    for (const SessionTotals& session : batch.totals) BookTotals(session, &added);
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

  absl::StatusOr<std::map<std::string, UsageCounts>> MonthOf(absl::Time time) override {
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

  absl::StatusOr<std::vector<std::string>> Parts() override {
    absl::MutexLock lock(&mutex_);
    std::vector<std::string> names;
    for (const auto& [part, revision] : revisions_) names.push_back(part);
    return names;
  }

  absl::StatusOr<UsagePart> Read(const std::string& part) override {
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

  absl::Status Replace(const UsagePart& source, const UsagePart& target,
                       const std::string& packed) override {
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

  absl::Status Forget(absl::Duration unused) override {
    const int64_t oldest = absl::ToUnixSeconds(Now() - unused);
    return ForgetSessions([&](absl::string_view, int64_t seconds) { return seconds < oldest; });
  }

  absl::Status ForgetAllBut(const std::set<std::string>& sessions) override {
    return ForgetSessions([&](absl::string_view session, int64_t) {
      return !sessions.contains(std::string(session));
    });
  }

 private:
  // The ledger as keys and values: `s/` with a session has its totals, `t/` with a month and a
  // tenant, and `o.../` with a series, have counts, and the other parts have packed rows.
  using Table = std::map<std::string, std::string>;

  absl::Status Load(const std::string& directory) ABSL_LOCKS_EXCLUDED(mutex_) {
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
          // Nobody knows how long the server was off, and its sessions did not get older by it.
          Set(std::string(key), absl::StartsWith(key, kSessionPrefix)
                                    ? FormatTotals(Now(), ParseTotals(value).second)
                                    : std::string(value));
        }));
    changed_.clear();
    return transaction.Commit();
  }

  void Set(const std::string& key, std::string value) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const auto [at, is_new] = table_.insert_or_assign(key, std::move(value));
    changed_.insert(key);
    const std::string part(PartOf(key));
    if (part.empty()) return;
    ++revisions_[part];
    if (is_new && part[0] == 'o') ++series_[part];
  }

  void Remove(const std::string& key) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    table_.erase(key);
    changed_.insert(key);
  }

  void Add(const std::string& key, const UsageCounts& counts)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const auto found = table_.find(key);
    UsageCounts sum = found == table_.end() ? UsageCounts() : ParseCounts(found->second);
    sum += counts;
    Set(key, FormatCounts(sum));
  }

  // Adds what is new since the session was booked to `added`.
  void BookTotals(const SessionTotals& session, std::map<std::string, UsageCounts>* added)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const std::string key = absl::StrCat(kSessionPrefix, session.session);
    UsageTotals booked = BookedTotals(key);
    UsageCounts& counts = (*added)[session.series];
    for (size_t i = 0; i < booked.size(); ++i) {
      const double more = std::max(0.0, session.totals[i] - booked[i]);
      counts.values[i] += more;
      booked[i] = std::max(booked[i], session.totals[i]);
    }
    Set(key, FormatTotals(Now(), booked));
  }

  UsageTotals BookedTotals(const std::string& key) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const auto found = table_.find(key);
    return found == table_.end() ? UsageTotals() : ParseTotals(found->second).second;
  }

  // Forgets the totals of the sessions for which `is_old` returns true, by id and time.
  template <typename IsOld>
  absl::Status ForgetSessions(IsOld is_old) ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    std::vector<std::string> old;
    for (auto at = table_.lower_bound(kSessionPrefix); at != table_.end(); ++at) {
      absl::string_view session = at->first;
      if (!absl::ConsumePrefix(&session, kSessionPrefix)) break;
      if (is_old(session, ParseTotals(at->second).first)) old.push_back(at->first);
    }
    for (const std::string& key : old) Remove(key);
    return Flush();
  }

  // Returns the time of day at which the store was opened, and what has passed since then.
  absl::Time Now() const { return opened_at_ + (clock_.Now() - opened_); }

  std::string RevisionOf(const std::string& part) const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const auto found = revisions_.find(part);
    return found == revisions_.end() ? "" : absl::StrCat(found->second);
  }

  // Writes what has changed to the disk.
  absl::Status Flush() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
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

  const Clock& clock_;
  const absl::Duration opened_;  // of `clock_`
  const absl::Time opened_at_ = absl::Now();
  FileDescriptor lock_;  // of the folder, so that no other server uses it
  absl::Mutex mutex_;
  Table table_ ABSL_GUARDED_BY(mutex_);
  std::map<std::string, uint64_t> revisions_ ABSL_GUARDED_BY(mutex_);  // of the parts
  std::map<std::string, size_t> series_ ABSL_GUARDED_BY(mutex_);       // of the open parts
  std::set<std::string> changed_ ABSL_GUARDED_BY(mutex_);  // keys, since the last Flush()
  LmdbEnvironment environment_ ABSL_GUARDED_BY(mutex_);    // null: memory alone
  MDB_dbi records_ ABSL_GUARDED_BY(mutex_) = 0;
};

}  // namespace

absl::StatusOr<std::unique_ptr<LocalUsageStore>> LocalUsageStore::Open(const std::string& directory,
                                                                       const Clock* clock) {
  static const SteadyClock steady;
  auto store = std::make_unique<LocalStore>(clock == nullptr ? &steady : clock);
  if (!directory.empty()) RETURN_IF_ERROR(store->OpenFolder(directory));
  return store;
}

}  // namespace spikeserve
