#include "server/store/journal_store.h"

#include <algorithm>
#include <iterator>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "core/journal/session_journal.h"
#include "server/base/log.h"
#include "server/base/retry_delay.h"

namespace spikeserve {
namespace {

// Records that no answer waits for gather for this time, or up to this number.
constexpr absl::Duration kGatherTime = absl::Milliseconds(4);
constexpr size_t kGatherRecords = 256;

// The largest number of records that are written together.
constexpr size_t kMostRecords = 512;

// How often a connection without work is tried.
constexpr absl::Duration kIdleInterval = absl::Seconds(1);

// When journals are compared again of some of which the store has not told anything.
constexpr absl::Duration kUntoldInterval = absl::Seconds(5);

// What a record without bytes counts in the backlog.
constexpr size_t kRecordBytes = 256;

size_t BacklogOf(const JournalRecord& record) {
  return record.bytes.empty() ? kRecordBytes : record.bytes.size();
}

constexpr absl::Duration kFirstStoreRetry = absl::Milliseconds(20);
constexpr absl::Duration kRefusedRetry = absl::Milliseconds(100);
constexpr absl::Duration kLongestStoreRetry = absl::Seconds(1);

prometheus::Counter& AddCounter(prometheus::Registry* registry, const char* name, const char* help,
                                const prometheus::Labels& labels = {}) {
  return prometheus::BuildCounter().Name(name).Help(help).Register(*registry).Add(labels);
}

constexpr char kRecords[] = "spikeserve_store_records_total";
constexpr char kRecordsHelp[] =
    "Records of session journals that the store has written, or refused because another server "
    "owns the session.";
constexpr char kClaims[] = "spikeserve_store_claims_total";
constexpr char kClaimsHelp[] =
    "Sessions that this server took over from the store, or could not take over.";

}  // namespace

JournalStore::JournalStore(std::unique_ptr<JournalBackend> backend, const Clock* clock,
                           prometheus::Registry* registry, absl::Duration check_interval)
    : backend_(std::move(backend)),
      is_shared_(backend_->IsShared()),
      clock_(clock),
      check_interval_(check_interval),
      written_(AddCounter(registry, kRecords, kRecordsHelp, {{"outcome", "written"}})),
      refused_(AddCounter(registry, kRecords, kRecordsHelp, {{"outcome", "refused"}})),
      acknowledgement_(
          prometheus::BuildHistogram()
              .Name("spikeserve_store_acknowledgement_seconds")
              .Help("Time from a decision to the store's acknowledgement of its record.")
              .Register(*registry)
              .Add({}, prometheus::Histogram::BucketBoundaries{1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3,
                                                               5e-3, 1e-2, 2.5e-2, 0.1, 0.25, 1.0,
                                                               2.5, 10.0})),
      backlog_gauge_(prometheus::BuildGauge()
                         .Name("spikeserve_store_backlog_bytes")
                         .Help("Bytes of records that wait for the store.")
                         .Register(*registry)
                         .Add({})),
      claimed_(AddCounter(registry, kClaims, kClaimsHelp, {{"outcome", "claimed"}})),
      claims_failed_(AddCounter(registry, kClaims, kClaimsHelp, {{"outcome", "failed"}})),
      fences_(AddCounter(registry, "spikeserve_store_fences_total",
                         "Sessions that another server has taken over while this one had them.")),
      reseeds_(AddCounter(registry, "spikeserve_store_reseeds_total",
                          "Sessions that were written again because the store had lost them.")),
      replayed_(AddCounter(registry, "spikeserve_store_replayed_entries_total",
                           "Decisions that were read from journals to restore sessions.")),
      reachable_gauge_(prometheus::BuildGauge()
                           .Name("spikeserve_store_reachable")
                           .Help("1 while the store answers and refuses no records, otherwise 0.")
                           .Register(*registry)
                           .Add({})),
      retry_delay_(kFirstStoreRetry),
      refused_delay_(kRefusedRetry) {
  reachable_gauge_.Set(1.0);
  KeepJournals();  // so that the first sessions find out what the store does not keep
  thread_ = std::thread([this] { Run(); });
}

JournalStore::~JournalStore() { Stop(absl::ZeroDuration()); }

void JournalStore::Write(JournalRecord record) {
  record.queued = clock_->Now();
  backlog_bytes_.fetch_add(BacklogOf(record), std::memory_order_relaxed);
  absl::MutexLock lock(&mutex_);
  const bool was_urgent = IsUrgent();
  queue_.records.push_back(std::move(record));
  if (idle_ || (!was_urgent && IsUrgent())) changed_.NotifyAll();
}

void JournalStore::Hurry() {
  absl::MutexLock lock(&mutex_);
  if (queue_.records.empty()) return;  // the thread has them
  const bool was_urgent = IsUrgent();
  hurried_ = true;
  if (!was_urgent) changed_.NotifyAll();
}

absl::Status JournalStore::CheckReachable() const {
  if (reachable_.load(std::memory_order_acquire)) return absl::OkStatus();
  return WithRetryDelay(absl::UnavailableError("session store: cannot be reached; try again"),
                        kLongestStoreRetry);
}

absl::Status JournalStore::CheckBacklog() const {
  const size_t bytes = backlog_bytes_.load(std::memory_order_relaxed);
  if (bytes < kMostBacklogBytes) return absl::OkStatus();
  return WithRetryDelay(absl::UnavailableError(absl::StrCat(
                            "session store: expected a backlog of less than ", kMostBacklogBytes,
                            " bytes, received ", bytes, "; try again")),
                        kLongestStoreRetry);
}

absl::Status JournalStore::CheckKeepsRecords() const {
  if (!may_lose_records_.load(std::memory_order_relaxed)) return absl::OkStatus();
  absl::MutexLock lock(&mutex_);
  return keeps_records_;
}

void JournalStore::Claim(JournalClaim claim, Claimed claimed) {
  if (auto status = CheckReachable(); !status.ok()) return claimed(status);
  absl::MutexLock lock(&mutex_);
  queue_.claims.push_back({std::move(claim), std::move(claimed)});
  changed_.NotifyAll();
}

void JournalStore::Stop(absl::Duration timeout) {
  if (!thread_.joinable()) return;
  {
    absl::MutexLock lock(&mutex_);
    stopping_ = true;
    stop_by_ = clock_->Now() + timeout;
    changed_.NotifyAll();
  }
  thread_.join();
}

bool JournalStore::HasWork() const {
  return !queue_.records.empty() || !queue_.claims.empty() || stopping_;
}

bool JournalStore::IsUrgent() const {
  return hurried_ || queue_.records.size() >= kGatherRecords || !queue_.claims.empty() || stopping_;
}

absl::Duration JournalStore::IdleInterval() const {
  if (waiting_.empty()) return kIdleInterval;
  return std::clamp(try_refused_at_ - clock_->Now(), absl::ZeroDuration(), kIdleInterval);
}

std::optional<JournalStore::Work> JournalStore::Next() {
  absl::MutexLock lock(&mutex_);
  // While there are records all the time, the thread wakes once for all that gather.
  const auto urgent = [this]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) { return IsUrgent(); };
  const auto any = [this]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) { return HasWork(); };
  if (!changed_.Wait(&mutex_, kGatherTime, urgent) && !HasWork()) {
    idle_ = true;
    const bool has_work = changed_.Wait(&mutex_, IdleInterval(), any);
    idle_ = false;
    if (has_work) changed_.Wait(&mutex_, kGatherTime, urgent);
  }
  if (stopping_ && queue_.records.empty() && queue_.claims.empty()) {
    const absl::Duration now = clock_->Now();
    if (waiting_.empty() || now >= stop_by_) return std::nullopt;
    changed_.Wait(&mutex_, std::min(try_refused_at_, stop_by_) - now, [] { return false; });
  }
  Work work = std::exchange(queue_, {});
  hurried_ = false;
  return work;
}

void JournalStore::Run() {
  while (true) {
    std::optional<Work> work = Next();
    if (!work.has_value()) return;
    const bool all_written = KeepJournals() && WriteRecords(&work->records);
    RunClaims(std::move(work->claims));
    if (!all_written && !WaitToRetry(std::move(work->records))) return DropClaims();
  }
}

bool JournalStore::KeepJournals() {
  const auto may_have_lost = backend_->Connect();
  absl::Status status = may_have_lost.status();
  if (status.ok()) {
    if (*may_have_lost) must_check_ = true;
    absl::Status keeps = backend_->CheckKeepsRecords();
    {
      absl::MutexLock lock(&mutex_);
      may_lose_records_.store(!keeps.ok(), std::memory_order_relaxed);
      keeps_records_ = std::move(keeps);
    }
    if (must_check_ || clock_->Now() >= next_check_) status = CheckJournals();
  }
  if (!status.ok()) SetReachable(status);
  return status.ok();
}

absl::Status JournalStore::CheckJournals() {
  SessionStore* const sessions = sessions_.load(std::memory_order_acquire);
  std::vector<HeldJournal> held;
  const auto is_stored = [](const SessionEntry& entry) { return entry.journal != nullptr; };
  const auto add = [&](const ListedSession& session) {
    held.push_back({session.entry->journal, session.idle <= check_interval_});
  };
  if (sessions != nullptr && is_shared_) sessions->ForEach(is_stored, add);
  std::vector<std::shared_ptr<SessionJournal>> missing;
  bool all_told = true;
  for (size_t first = 0; first < held.size(); first += kMostRecords) {
    const auto part = absl::MakeConstSpan(held).subspan(first, kMostRecords);
    ASSIGN_OR_RETURN(const auto outcomes, backend_->Check(part));
    for (size_t i = 0; i < part.size(); ++i) {
      if (absl::IsAborted(outcomes[i]) && !part[i].journal->lost()) fences_.Increment();
      part[i].journal->OnChecked(outcomes[i]);
      all_told = all_told && !absl::IsUnavailable(outcomes[i]);
      if (part[i].journal->missing()) missing.push_back(part[i].journal);
    }
  }
  must_check_ = false;
  next_check_ = clock_->Now() + (all_told ? check_interval_ : kUntoldInterval);
  WriteAgain(missing);
  return absl::OkStatus();
}

void JournalStore::WriteAgain(const std::vector<std::shared_ptr<SessionJournal>>& journals) {
  SessionStore* const sessions = sessions_.load(std::memory_order_acquire);
  if (sessions == nullptr || journals.empty()) return;
  for (const auto& journal : journals) {
    const auto entry = sessions->Peek(journal->key().id, journal->key().tenant);
    if (entry == nullptr || entry->journal != journal || journal->lost()) {
      // Nobody can write it again, so nobody should wait for that. A copy that was given up may be
      // the last one nevertheless, and is not lost because of this.
      journal->OnUnreachable(
          absl::UnavailableError("session_id: expected a session of this server, received one that "
                                 "it has given up; try again"));
      continue;
    }
    absl::MutexLock lock(&entry->mutex);
    journal->WriteAgainIfMissing(entry->agent.session());
  }
  Hurry();
}

void JournalStore::DropClaims() {
  Work work;
  {
    absl::MutexLock lock(&mutex_);
    work = std::exchange(queue_, {});
  }
  const absl::Status stopped = absl::UnavailableError("session store: stopped; try again");
  for (ClaimRequest& request : work.claims) request.claimed(stopped);
}

size_t JournalStore::SkipReplaced(size_t first, size_t end, std::vector<JournalRecord>* records) {
  const auto part = absl::MakeSpan(*records).subspan(first, end - first);
  const auto kept = std::stable_partition(
      part.begin(), part.end(),
      [](const JournalRecord& record) { return record.journal->IsReplaced(record); });
  for (auto replaced = part.begin(); replaced != kept; ++replaced) {
    backlog_bytes_.fetch_sub(BacklogOf(*replaced), std::memory_order_relaxed);
  }
  return first + static_cast<size_t>(kept - part.begin());
}

bool JournalStore::TryRefusedAgain(std::vector<JournalRecord>* records) {
  // The end of a session makes its other records superfluous.
  const auto ends = [this](const JournalRecord& record) {
    return record.kind == JournalRecord::Kind::kClose &&
           waiting_journals_.contains(record.journal.get());
  };
  const bool is_due = clock_->Now() >= try_refused_at_;
  if (!is_due && std::ranges::none_of(*records, ends)) return waiting_.empty();
  std::ranges::move(*records, std::back_inserter(waiting_));
  *records = std::exchange(waiting_, {});
  waiting_journals_.clear();
  return true;
}

bool JournalStore::WriteRecords(std::vector<JournalRecord>* records) {
  const bool tried = TryRefusedAgain(records);
  size_t first = 0;
  absl::Status failure;
  while (first < records->size() && failure.ok()) {
    const size_t end = std::min(first + kMostRecords, records->size());
    auto batch = TakeBatch(SkipReplaced(first, end, records), end, records);
    first = end;
    const auto ends = [](const JournalRecord& record) {
      return record.kind == JournalRecord::Kind::kClose;
    };
    const bool is_kept = sessions_.load(std::memory_order_acquire) != nullptr;
    if (is_kept && before_ends_ != nullptr && std::ranges::any_of(batch, ends)) {
      before_ends_();
    }
    const auto outcomes = backend_->Write(batch);
    failure = outcomes.status();
    if (failure.ok()) {
      TakeOutcomes(std::move(batch), *outcomes);
    } else {
      first -= batch.size();
      std::ranges::move(batch, records->begin() + static_cast<ptrdiff_t>(first));
    }
  }
  backlog_gauge_.Set(static_cast<double>(backlog_bytes_.load(std::memory_order_relaxed)));
  records->erase(records->begin(), records->begin() + static_cast<ptrdiff_t>(first));
  if (failure.ok()) NoteRefusals(tried);
  SetReachable(failure);
  return failure.ok();
}

std::vector<JournalRecord> JournalStore::TakeBatch(size_t first, size_t end,
                                                   std::vector<JournalRecord>* records) {
  std::vector<JournalRecord> batch;
  for (JournalRecord& record : absl::MakeSpan(*records).subspan(first, end - first)) {
    if (waiting_journals_.contains(record.journal.get())) {
      Refuse(std::move(record));
    } else {
      batch.push_back(std::move(record));
    }
  }
  return batch;
}

void JournalStore::Refuse(JournalRecord record) {
  const auto journal = record.journal;
  waiting_.push_back(std::move(record));
  waiting_journals_.insert(journal.get());
  journal->OnUnreachable(WithRetryDelay(refusal_, kLongestStoreRetry));
}

void JournalStore::NoteRefusals(bool tried) {
  const bool refuses = !waiting_.empty();
  if (tried && refuses) try_refused_at_ = clock_->Now() + refused_delay_;
  if (tried)
    refused_delay_ = refuses ? std::min(2 * refused_delay_, kLongestStoreRetry) : kRefusedRetry;
  if (refuses == std::exchange(said_refusal_, refuses)) return;
  if (refuses) {
    LogError("session store refuses records of some sessions; tries again",
             {{"sessions", absl::StrCat(waiting_journals_.size())}, {"error", refusal_.message()}});
  } else {
    LogInfo("session store takes all records again");
  }
}

void JournalStore::TakeOutcomes(std::vector<JournalRecord> batch,
                                const std::vector<absl::Status>& outcomes) {
  std::vector<std::shared_ptr<SessionJournal>> missing;
  for (size_t i = 0; i < outcomes.size(); ++i) {
    JournalRecord& record = batch[i];
    if (absl::IsUnavailable(outcomes[i])) {
      refusal_ = outcomes[i];
      Refuse(std::move(record));
      continue;
    }
    (outcomes[i].ok() ? written_ : refused_).Increment();
    Count(record, outcomes[i]);
    backlog_bytes_.fetch_sub(BacklogOf(record), std::memory_order_relaxed);
    record.journal->OnWritten(record, outcomes[i]);
    if (record.journal->missing()) missing.push_back(record.journal);
  }
  WriteAgain(missing);
}

void JournalStore::Count(const JournalRecord& record, const absl::Status& outcome) {
  acknowledgement_.Observe(absl::ToDoubleSeconds(clock_->Now() - record.queued));
  const bool reseeds = record.kind == JournalRecord::Kind::kOpen && record.position > 1;
  if (outcome.ok() && reseeds) reseeds_.Increment();
  if (absl::IsAborted(outcome) && !record.journal->lost()) fences_.Increment();
}

void JournalStore::RunClaims(std::vector<ClaimRequest> requests) {
  if (requests.empty()) return;
  std::vector<JournalClaim> claims;
  for (ClaimRequest& request : requests) claims.push_back(std::move(request.claim));
  const absl::Status reachable = CheckReachable();
  using Results = std::vector<absl::StatusOr<ClaimedJournal>>;
  auto results = reachable.ok() ? backend_->Claim(claims) : Results(claims.size(), reachable);
  for (size_t i = 0; i < requests.size(); ++i) {
    auto& result = results[i];
    if (claims[i].only_reads) {
      // The session stays with its owner.
    } else if (result.ok()) {
      (result->epoch > 0 ? claimed_ : claims_failed_).Increment();
    } else if (!absl::IsNotFound(result.status())) {
      claims_failed_.Increment();
    }
    requests[i].claimed(std::move(result));
  }
}

void JournalStore::SetReachable(const absl::Status& status) {
  const bool was_reachable = reachable_.exchange(status.ok(), std::memory_order_acq_rel);
  reachable_gauge_.Set(status.ok() && !said_refusal_ ? 1.0 : 0.0);
  if (status.ok()) retry_delay_ = kFirstStoreRetry;
  if (was_reachable == status.ok()) return;
  if (status.ok()) {
    LogInfo("session store reached");
  } else {
    LogError("session store not reached; tries again", {{"error", status.message()}});
  }
}

bool JournalStore::WaitToRetry(std::vector<JournalRecord> records) {
  std::vector<std::shared_ptr<SessionJournal>> journals;
  {
    absl::MutexLock lock(&mutex_);
    std::ranges::move(queue_.records, std::back_inserter(records));
    queue_.records = std::move(records);
    for (const JournalRecord& record : queue_.records) journals.push_back(record.journal);
  }
  const absl::Status away = CheckReachable();
  for (const auto& journal : journals) journal->OnUnreachable(away);
  absl::MutexLock lock(&mutex_);
  const auto gave_up = [this]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    return stopping_ && (clock_->Now() >= stop_by_ || queue_.records.empty());
  };
  changed_.Wait(&mutex_, retry_delay_, gave_up);
  retry_delay_ = std::min(2 * retry_delay_, kLongestStoreRetry);
  return !gave_up();
}

}  // namespace spikeserve
