#include "server/heads/head_log_store.h"

#include <algorithm>
#include <iterator>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/agent/served_policy.h"
#include "server/base/log.h"
#include "server/base/retry_delay.h"
#include "server/heads/version_log.h"

namespace spikeserve {
namespace {

// The interval of reading a log while this server appends nothing.
constexpr absl::Duration kReadInterval = absl::Milliseconds(100);

// Logs whose heads no session of this server uses are read once a second, or one after the other if
// there are more of them: this many in a second.
constexpr absl::Duration kUnusedReadInterval = absl::Seconds(1);
constexpr int64_t kUnusedReadsPerInterval = 32;

// How often this server looks which heads its sessions use. What it has read of a log is as old as
// this, at most, when a session has begun to use it.
constexpr absl::Duration kUseInterval = absl::Seconds(1);

// How often a store that stops tries to append what waits.
constexpr absl::Duration kStopInterval = absl::Milliseconds(10);

constexpr absl::Duration kFirstRetry = absl::Milliseconds(100);
constexpr absl::Duration kLongestRetry = absl::Seconds(1);

// Contributors are kept alive at this interval, which is a fraction of the time that they count.
constexpr absl::Duration kMembersInterval = absl::Seconds(1);

// How long a server waits for a snapshot of another one before it cuts a log at its gap.
constexpr absl::Duration kGapPatience = absl::Seconds(5);

// How long the settings and a log may differ in a pause: longer than a change of the settings takes
// to reach this server.
constexpr absl::Duration kPausePatience = absl::Seconds(5);

// A connection that breaks fails once. What fails again has another cause, which is logged.
constexpr int kFailuresToLog = 2;

// Entries that are appended together.
constexpr size_t kMostAppends = 16;

prometheus::Counter& AddCounter(prometheus::Registry* registry, const char* name, const char* help,
                                const char* outcome) {
  return prometheus::BuildCounter().Name(name).Help(help).Register(*registry).Add(
      {{"outcome", outcome}});
}

constexpr char kEntries[] = "spikeserve_head_log_entries_total";
constexpr char kEntriesHelp[] =
    "Entries of the logs of shared heads that this server has appended, found there already "
    "(known), or taken into its heads (folded).";
constexpr char kReloads[] = "spikeserve_head_log_reloads_total";
constexpr char kReloadsHelp[] =
    "Times that a log did not go on from the heads of this server, which then took the stored "
    "heads (reloaded), stored its own (rewritten), or gave up the entries after a gap (cut).";

}  // namespace

HeadLogStore::HeadLogStore(RedisOptions options, absl::Duration retention, const Clock* clock,
                           prometheus::Registry* registry)
    : options_(std::move(options)),
      retention_(retention),
      clock_(clock),
      appended_(AddCounter(registry, kEntries, kEntriesHelp, "appended")),
      known_(AddCounter(registry, kEntries, kEntriesHelp, "known")),
      folded_(AddCounter(registry, kEntries, kEntriesHelp, "folded")),
      reloaded_(AddCounter(registry, kReloads, kReloadsHelp, "reloaded")),
      rewritten_(AddCounter(registry, kReloads, kReloadsHelp, "rewritten")),
      cut_(AddCounter(registry, kReloads, kReloadsHelp, "cut")),
      positions_(prometheus::BuildGauge()
                     .Name("spikeserve_head_log_position")
                     .Help("Number of the last entry of the log of a shared head that this server "
                           "has taken.")
                     .Register(*registry)) {
  thread_ = std::thread([this] { Run(); });
}

HeadLogStore::~HeadLogStore() { Stop(absl::ZeroDuration()); }

std::shared_ptr<HeadLog> HeadLogStore::Open(const ServedPolicy& served) {
  const std::string key = HeadLogKeys(served.name, served.version, served.sha256).log;
  absl::MutexLock lock(&mutex_);
  std::weak_ptr<VersionLog>& known = logs_[key];
  std::shared_ptr<VersionLog> log = known.lock();
  if (log == nullptr) {
    log = std::make_shared<VersionLog>(this, served);
    known = log;
    has_requests_ = true;  // it is to be read
    changed_.NotifyAll();
  }
  return log;
}

void HeadLogStore::WaitToJoin(absl::Duration timeout) {
  absl::MutexLock lock(&mutex_);
  changed_.Wait(&mutex_, timeout, [this] { return has_joined(); });
}

void HeadLogStore::Stop(absl::Duration timeout) {
  if (!thread_.joinable()) return;
  {
    absl::MutexLock lock(&mutex_);
    stopping_ = true;
    stop_by_ = clock_->Now() + timeout;
    changed_.NotifyAll();
  }
  thread_.join();
  const absl::Status stopped = absl::UnavailableError("session store: stopped; try again");
  for (const auto& log : Logs()) {
    for (Request& request : Take(*log)) {
      if (request.contribution != nullptr) request.contribution->OnUnreachable(stopped);
      if (request.operation == nullptr) continue;
      request.operation->outcome = stopped;
      request.operation->done.Notify();
    }
  }
}

void HeadLogStore::Add(VersionLog* log, Request request) {
  absl::MutexLock lock(&mutex_);
  log->requests.push_back(std::move(request));
  has_requests_ = true;
  changed_.NotifyAll();
}

bool HeadLogStore::Wait() {
  absl::MutexLock lock(&mutex_);
  const auto is_due = [this]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    return has_requests_ || stopping_;
  };
  changed_.Wait(&mutex_, kReadInterval, is_due);
  has_requests_ = false;
  if (!stopping_) return true;
  const bool waits = std::any_of(logs_.begin(), logs_.end(), [](const auto& item) {
    const auto log = item.second.lock();
    return log != nullptr && !log->requests.empty();
  });
  const auto is_over = [this]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    return clock_->Now() >= stop_by_;
  };
  return waits && !changed_.Wait(&mutex_, kStopInterval, is_over);
}

bool HeadLogStore::IsOver() {
  absl::MutexLock lock(&mutex_);
  return stopping_ && clock_->Now() >= stop_by_;
}

void HeadLogStore::NoteUse(const std::vector<std::shared_ptr<VersionLog>>& logs) {
  const absl::Duration now = clock_->Now();
  if (now - use_noted_ < kUseInterval) return;
  use_noted_ = now;
  int64_t unused = 0;
  for (const auto& log : logs) {
    const auto tenants = log->heads()->Tenants();
    const bool is_used = std::any_of(tenants.begin(), tenants.end(), [&](const auto& tenant) {
      return !log->heads()->Of(tenant)->Members().empty();
    });
    if (is_used && !log->is_used) log->read_at = now;
    log->is_used = is_used;
    if (!is_used) ++unused;
  }
  unused_interval_ =
      kUnusedReadInterval * std::max(1.0, static_cast<double>(unused) / kUnusedReadsPerInterval);
}

std::vector<std::shared_ptr<VersionLog>> HeadLogStore::Logs() {
  std::vector<std::shared_ptr<VersionLog>> logs;
  absl::MutexLock lock(&mutex_);
  for (auto it = logs_.begin(); it != logs_.end();) {
    if (auto log = it->second.lock(); log != nullptr) {
      logs.push_back(std::move(log));
      ++it;
    } else {
      it = logs_.erase(it);
    }
  }
  return logs;
}

HeadLogStore::Requests HeadLogStore::Take(VersionLog& log) {
  absl::MutexLock lock(&mutex_);
  Requests requests = std::exchange(log.requests, {});
  if (requests.size() <= kMostAppends) return requests;
  const auto first_later = requests.begin() + kMostAppends;
  log.requests.assign(std::make_move_iterator(first_later),
                      std::make_move_iterator(requests.end()));
  requests.erase(first_later, requests.end());
  has_requests_ = true;
  return requests;
}

void HeadLogStore::Run() {
  while (Wait()) {
    const auto logs = Logs();
    NoteUse(logs);
    const absl::Status connected = Connect();
    for (const auto& log : logs) {
      if (IsOver()) break;
      if (!connected.ok()) {
        log->failures = 0;
        Fail(*log, Take(*log), connected);
      } else if (const absl::Duration now = clock_->Now(); now >= log->retry_at) {
        Requests requests = Take(*log);
        if (!requests.empty() || now >= log->read_at) Serve(*log, std::move(requests));
      }
    }
    const bool joined =
        std::all_of(logs.begin(), logs.end(), [](const auto& log) { return log->has_joined; });
    if (joined && !has_joined() && !logs.empty()) {
      absl::MutexLock lock(&mutex_);
      joined_.store(true, std::memory_order_release);
      changed_.NotifyAll();  // wakes WaitToJoin()
    }
  }
}

void HeadLogStore::Serve(VersionLog& log, Requests requests) {
  log.outcomes.clear();
  absl::Status status = Exchange(log, requests);
  if (absl::IsUnavailable(status)) {
    // The connection may be one that Redis has closed since it was used last.
    client_ = nullptr;
    for (Request& request : requests) request.is_in_log = false;  // Redis may have lost it
    status = Exchange(log, requests);
  }
  if (!status.ok()) {
    // JournalStore says that the store cannot be reached.
    if (++log.failures == kFailuresToLog) {
      LogError("shared heads not taken from their log; tries again",
               {{"policy", log.name}, {"error", status.message()}});
    }
    return Fail(log, std::move(requests), status);
  }
  log.failures = 0;
  // Logs that were read together are read at different times later.
  log.read_at = clock_->Now() +
                (log.is_used ? kReadInterval : unused_interval_ * absl::Uniform(random_, 0.5, 1.5));
  log.retry_delay = kFirstRetry;
  Finish(log, requests);
  CorrectPause(log);
}

absl::Status HeadLogStore::Connect() {
  if (client_ != nullptr && client_->is_usable()) return absl::OkStatus();
  auto connected = RedisClient::Connect(options_);
  if (connected.ok()) client_ = *std::move(connected);
  return connected.status();
}

absl::Status HeadLogStore::Exchange(VersionLog& log, Requests& requests) {
  if (auto status = Connect(); !status.ok()) return status;
  if (!log.has_joined) {
    if (auto status = Reload(log, ""); !status.ok()) return status;
    log.has_joined = true;
  }
  constexpr int kMostAttempts = 4;
  for (int i = 0; i < kMostAttempts; ++i) {
    const auto all = AppendAndRead(log, requests);
    if (!all.ok()) return all.status();
    if (!*all) continue;
    const bool has_appended =
        std::any_of(requests.begin(), requests.end(), [](const auto& each) { return each.is_new; });
    if (auto status = StoreSnapshotIfDue(log, has_appended); !status.ok()) return status;
    return KeepMembers(log);
  }
  return absl::UnavailableError("session store: the log of a shared head changes; try again");
}

absl::StatusOr<bool> HeadLogStore::AppendAndRead(VersionLog& log, Requests& requests) {
  const auto waits = [](const Request& each) {
    return !each.is_in_log && !each.append.bytes.empty();
  };
  for (Request& request : requests) {
    if (!waits(request)) continue;
    // The log may have forgotten that it has the entry, if Redis has lost something.
    if (log.replica.Find(request.append.session, request.append.episode).has_value()) {
      request.is_in_log = true;
      request.is_new = request.is_sent;
      (request.is_new ? appended_ : known_).Increment();
      continue;
    }
    if (const auto head = log.heads()->Find(request.append.head); head != nullptr) {
      request.append.members = head->Members();
    }
    SendHeadAppend(*client_, log.keys, log.replica.position(), request.append, retention_);
  }
  SendHeadTail(*client_, log.keys, log.replica.position());
  bool is_stale = false;
  for (Request& request : requests) {
    if (!waits(request)) continue;
    const bool was_sent = std::exchange(request.is_sent, true);
    const auto outcome = ReadHeadAppend(*client_);
    if (!outcome.ok()) return outcome.status();
    if (*outcome == AppendOutcome::kStale) {
      is_stale = true;
      continue;
    }
    request.is_in_log = true;
    request.is_new = *outcome == AppendOutcome::kAppended || was_sent;
    (request.is_new ? appended_ : known_).Increment();
  }
  const auto tail = ReadHeadTail(*client_);
  if (!tail.ok()) return tail.status();
  if (options_.replicas > 0) {
    if (auto status = client_->WaitForReplicas(); !status.ok()) return status;
  }
  auto status = FoldTail(log, *tail);
  if (status.ok() && tail->entries.size() == kMostTailEntries) status = ReadOn(log);
  if (absl::IsDataLoss(status)) status = Reload(log, status.message());
  if (!status.ok()) return status;
  positions_.Add(log.labels).Set(static_cast<double>(log.replica.position().number));
  return !is_stale;
}

absl::Status HeadLogStore::ReadOn(VersionLog& log) {
  while (true) {
    SendHeadTail(*client_, log.keys, log.replica.position());
    const auto tail = ReadHeadTail(*client_);
    if (!tail.ok()) return tail.status();
    if (auto status = FoldTail(log, *tail); !status.ok()) return status;
    if (tail->entries.size() < kMostTailEntries) return absl::OkStatus();
  }
}

absl::Status HeadLogStore::FoldTail(VersionLog& log, const LogTail& tail) {
  log.snapshot_number = tail.snapshot_number;
  log.wants_snapshot = tail.wants_snapshot;
  size_t first = 0;
  if (log.replica.position().number > 0) {
    if (tail.entries.empty() || tail.entries[0].position != log.replica.position()) {
      return absl::DataLossError(
          absl::StrCat("the log does not have entry ", log.replica.position().number, " any more"));
    }
    first = 1;
  } else if (tail.snapshot_number > 0) {
    return absl::DataLossError("the log has a snapshot, but no entry was taken");
  }
  for (size_t i = first; i < tail.entries.size(); ++i) {
    const auto folded = log.replica.Fold(tail.entries[i]);
    if (!folded.ok()) return folded.status();
    log.outcomes[{folded->session, folded->episode}] = folded->outcome;
    folded_.Increment();
  }
  return absl::OkStatus();
}

absl::Status HeadLogStore::Reload(VersionLog& log, absl::string_view reason) {
  const auto stored = LoadHeadLog(*client_, log.keys);
  if (!stored.ok()) return stored.status();
  HeadReplica whole(std::make_shared<TenantHeads>(log.heads()->policy()));
  if (!stored->bytes.empty()) {
    if (auto status = whole.Restore(stored->snapshot, stored->bytes); !status.ok()) {
      // Damaged, or of a later release. A server that has the heads stores them again.
      AskForHeadSnapshot(*client_, log.keys).IgnoreError();
      return status;
    }
  }
  const HeadPosition end =
      stored->entries.empty() ? whole.position() : stored->entries.back().position;
  for (const LoggedEntry& entry : stored->entries) {
    if (entry.position == whole.position()) continue;
    const auto folded = whole.Fold(entry);
    if (absl::IsDataLoss(folded.status())) return MendGap(log, whole, end);
    if (!folded.ok()) return folded.status();
    log.outcomes[{folded->session, folded->episode}] = folded->outcome;
  }
  log.gap_since.reset();
  const bool store_is_behind = log.replica.position().number > whole.position().number &&
                               log.replica.HasPassed(whole.position());
  if (store_is_behind) return Rewrite(log, log.replica, end, reason);
  log.replica.TakeOver(whole);
  log.snapshot_number = stored->snapshot.number;
  if (reason.empty()) return absl::OkStatus();
  reloaded_.Increment();
  LogWarning("shared heads reloaded from their log", {{"policy", log.name}, {"reason", reason}});
  return absl::OkStatus();
}

absl::Status HeadLogStore::Rewrite(VersionLog& log, const HeadReplica& replica,
                                   const HeadPosition& end, absl::string_view reason) {
  const auto status =
      ReplaceHeadLog(*client_, log.keys, end.digest, replica.position(), replica.Serialize());
  if (absl::IsAborted(status)) return absl::UnavailableError(status.message());
  if (!status.ok()) return status;
  // Those of older entries stay, unless Redis has lost them, too.
  std::vector<HeadMarker> markers;
  for (const HeadReplica::Folded& folded : replica.last()) {
    markers.push_back({folded.session, folded.episode, folded.position.id});
  }
  if (auto restored = RestoreHeadMarkers(*client_, log.keys, markers, retention_); !restored.ok()) {
    return restored;
  }
  rewritten_.Increment();
  LogWarning("shared heads written to their log again", {{"policy", log.name}, {"reason", reason}});
  return absl::OkStatus();
}

absl::Status HeadLogStore::MendGap(VersionLog& log, const HeadReplica& whole,
                                   const HeadPosition& end) {
  const std::string number = absl::StrCat(whole.position().number);
  if (!log.gap_since.has_value()) {
    log.gap_since = clock_->Now();
    LogError("the log of shared heads lacks entries; asks the other servers for their heads",
             {{"policy", log.name}, {"last_entry", number}});
  }
  if (clock_->Now() - *log.gap_since < kGapPatience) {
    if (auto status = AskForHeadSnapshot(*client_, log.keys); !status.ok()) return status;
    return absl::UnavailableError("session store: the log of a shared head lacks entries");
  }
  if (auto status = Rewrite(log, whole, end, "no server has the entries after the gap");
      !status.ok()) {
    return status;
  }
  cut_.Increment();
  LogError("the log of shared heads was cut; what came after the gap is lost",
           {{"policy", log.name}, {"last_entry", number}});
  log.replica.TakeOver(whole);
  log.gap_since.reset();
  return absl::OkStatus();
}

absl::Status HeadLogStore::StoreSnapshotIfDue(VersionLog& log, bool has_appended) {
  const HeadPosition& position = log.replica.position();
  // A server that appends stores the snapshot; any other one does if that one was lost.
  const int64_t entries = position.number - log.snapshot_number;
  const int64_t most = has_appended ? kEntriesPerSnapshot : 2 * kEntriesPerSnapshot;
  if (position.number == 0 || (entries < most && !log.wants_snapshot)) return absl::OkStatus();
  log.wants_snapshot = false;
  return StoreHeadSnapshot(*client_, log.keys, position, log.replica.Serialize());
}

absl::Status HeadLogStore::KeepMembers(VersionLog& log) {
  const absl::Duration now = clock_->Now();
  if (now - log.members_kept < kMembersInterval) return absl::OkStatus();
  log.members_kept = now;
  size_t sent = 0;
  for (const std::string& tenant : log.heads()->Tenants()) {
    const auto members = log.heads()->Of(tenant)->Members();
    if (members.empty()) continue;
    SendHeadMembers(*client_, log.keys, tenant, members);
    ++sent;
  }
  for (; sent > 0; --sent) {
    if (const auto reply = client_->Read(); !reply.ok()) return reply.status();
  }
  return absl::OkStatus();
}

void HeadLogStore::CorrectPause(VersionLog& log) {
  const bool paused = log.learning->paused();
  if (paused == log.replica.paused() || !follows_.load(std::memory_order_relaxed)) {
    log.pause_since.reset();
    return;
  }
  const absl::Duration now = clock_->Now();
  if (!log.pause_since.has_value()) log.pause_since = now;
  if (now - *log.pause_since < kPausePatience) return;
  log.pause_since.reset();
  Add(&log, VersionLog::NewRequest(paused ? HeadEntry::Kind::kPause : HeadEntry::Kind::kResume));
}

void HeadLogStore::Finish(VersionLog& log, Requests& requests) {
  for (Request& request : requests) {
    const auto folded = log.outcomes.find({request.append.session, request.append.episode});
    std::optional<MergeOutcome> outcome;
    if (folded != log.outcomes.end()) {
      outcome = folded->second;
    } else if (!request.append.bytes.empty()) {
      outcome = log.replica.Find(request.append.session, request.append.episode);
    }
    if (!outcome.has_value()) {
      // An entry from before those that are remembered.
      outcome.emplace();
      if (const auto head = log.heads()->Find(request.append.head); head != nullptr) {
        outcome->drift = head->Read()->drift;
        outcome->watched_return = head->Read()->level.mean;
      }
    }
    if (request.contribution != nullptr) request.contribution->OnMerged(*outcome, request.is_new);
    if (request.operation == nullptr) continue;
    request.operation->outcome = *outcome;
    request.operation->done.Notify();
  }
}

void HeadLogStore::Fail(VersionLog& log, Requests requests, const absl::Status& status) {
  client_ = nullptr;
  log.retry_at = clock_->Now() + log.retry_delay;
  log.retry_delay = std::min(2 * log.retry_delay, kLongestRetry);
  const absl::Status away = WithRetryDelay(
      absl::UnavailableError(absl::StrCat("shared head: ", status.message(), "; try again")),
      kLongestRetry);
  Requests again;
  for (Request& request : requests) {
    if (request.operation != nullptr) {
      request.operation->outcome = away;
      request.operation->done.Notify();
      continue;
    }
    if (request.contribution != nullptr) request.contribution->OnUnreachable(away);
    request.is_in_log = false;
    again.push_back(std::move(request));
  }
  absl::MutexLock lock(&mutex_);
  std::move(log.requests.begin(), log.requests.end(), std::back_inserter(again));
  log.requests = std::move(again);
}

}  // namespace spikeserve
