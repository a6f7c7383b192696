#include "server/heads/head_log_store.h"

#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/agent/served_policy.h"
#include "core/base/status_macros.h"
#include "prometheus/counter.h"
#include "server/heads/redis_head_log.h"

namespace spikeserve {
namespace {

// The interval of reading a log while this server appends nothing.
constexpr absl::Duration kReadInterval = absl::Milliseconds(100);

// Logs whose heads no session of this server uses are read once a second, or one after the other if
// there are more of them: this many in a second.
constexpr absl::Duration kUnusedReadInterval = absl::Seconds(1);
constexpr int64_t kUnusedReadsPerInterval = 32;

// How often a store that stops tries to append what waits.
constexpr absl::Duration kStopInterval = absl::Milliseconds(10);

HeadLogSettings NewSettings(absl::Duration retention, int64_t replicas, const Clock* clock,
                            prometheus::Registry* registry) {
  auto& entries =
      prometheus::BuildCounter()
          .Name("spikeserve_head_log_entries_total")
          .Help(
              "Entries of the logs of shared heads that this server has appended, found there "
              "already (known), or taken into its heads (folded).")
          .Register(*registry);
  auto& reloads =
      prometheus::BuildCounter()
          .Name("spikeserve_head_log_reloads_total")
          .Help(
              "Times that a log did not go on from the heads of this server, which then took the "
              "stored heads (reloaded), stored its own (rewritten), or gave up the entries after "
              "a gap (cut).")
          .Register(*registry);
  return {.retention = retention,
          .replicas = replicas,
          .clock = clock,
          .appended = entries.Add({{"outcome", "appended"}}),
          .known = entries.Add({{"outcome", "known"}}),
          .folded = entries.Add({{"outcome", "folded"}}),
          .reloaded = reloads.Add({{"outcome", "reloaded"}}),
          .rewritten = reloads.Add({{"outcome", "rewritten"}}),
          .cut = reloads.Add({{"outcome", "cut"}})};
}

}  // namespace

HeadLogStore::HeadLogStore(RedisOptions options, absl::Duration retention, const Clock* clock,
                           prometheus::Registry* registry)
    : options_(std::move(options)),
      settings_(NewSettings(retention, options_.replicas, clock, registry)) {
  thread_ = std::thread([this] { Run(); });
}

HeadLogStore::~HeadLogStore() { Stop(absl::ZeroDuration()); }

std::shared_ptr<HeadLog> HeadLogStore::Open(const ServedPolicy& served) {
  const std::string key = absl::StrCat(served.name, "/", served.version, "/", served.sha256);
  absl::MutexLock lock(&mutex_);
  std::weak_ptr<VersionLog>& known = logs_[key];
  std::shared_ptr<VersionLog> log = known.lock();
  if (log == nullptr) {
    log = std::make_shared<VersionLog>(&settings_, served, [this] { Wake(); });
    known = log;
    is_awake_ = true;  // it is to be read
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
    stop_by_ = settings_.clock->Now() + timeout;
    changed_.NotifyAll();
  }
  thread_.join();
  const absl::Status stopped = absl::UnavailableError("session store: stopped; try again");
  for (const auto& log : OpenLogs()) log->Close(stopped);
}

void HeadLogStore::Wake() {
  absl::MutexLock lock(&mutex_);
  is_awake_ = true;
  changed_.NotifyAll();
}

bool HeadLogStore::Wait() {
  absl::MutexLock lock(&mutex_);
  const auto is_due = [this]()
                          ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) { return is_awake_ || stopping_; };
  changed_.Wait(&mutex_, kReadInterval, is_due);
  is_awake_ = false;
  if (!stopping_) return true;
  const bool waits = std::any_of(logs_.begin(), logs_.end(), [](const auto& item) {
    const auto log = item.second.lock();
    return log != nullptr && log->has_requests();
  });
  const auto is_over = [this]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    return settings_.clock->Now() >= stop_by_;
  };
  return waits && !changed_.Wait(&mutex_, kStopInterval, is_over);
}

bool HeadLogStore::IsOver() {
  absl::MutexLock lock(&mutex_);
  return stopping_ && settings_.clock->Now() >= stop_by_;
}

HeadLogStore::Logs HeadLogStore::OpenLogs() {
  Logs logs;
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

std::map<std::pair<std::string, int64_t>, int64_t> HeadLogStore::Positions() {
  std::map<std::pair<std::string, int64_t>, int64_t> positions;
  for (const auto& log : OpenLogs()) {
    int64_t& position = positions[{log->policy(), log->version()}];
    position = std::max(position, log->position());
  }
  return positions;
}

void HeadLogStore::Run() {
  while (Wait()) {
    // A server that follows the settings has loaded all of its versions, even if these are none.
    const bool are_loaded = follows_.load(std::memory_order_acquire);
    const Logs logs = OpenLogs();
    const auto unused =
        std::count_if(logs.begin(), logs.end(), [](const auto& log) { return !log->is_used(); });
    unused_interval_ =
        kUnusedReadInterval * std::max(1.0, static_cast<double>(unused) / kUnusedReadsPerInterval);
    const absl::Status connected = Connect();
    for (const auto& log : logs) {
      if (IsOver()) break;
      if (!connected.ok()) {
        log->Fail(connected, /*is_connected=*/false);
      } else if (log->IsDue()) {
        Serve(*log);
      }
    }
    const bool joined =
        std::all_of(logs.begin(), logs.end(), [](const auto& log) { return log->has_joined(); });
    if (joined && are_loaded && !has_joined()) {
      absl::MutexLock lock(&mutex_);
      joined_.store(true, std::memory_order_release);
      changed_.NotifyAll();  // wakes WaitToJoin()
    }
  }
}

void HeadLogStore::Serve(VersionLog& log) {
  const auto exchange = [&]() -> absl::Status {
    RETURN_IF_ERROR(Connect());
    return log.Exchange(*client_);
  };
  absl::Status status = exchange();
  if (absl::IsUnavailable(status)) {
    // The connection may be one that Redis has closed since it was used last.
    client_ = nullptr;
    status = exchange();
  }
  if (!status.ok()) {
    client_ = nullptr;
    return log.Fail(status, /*is_connected=*/true);
  }
  // Logs that were read together are read at different times later.
  log.Finish(log.is_used() ? kReadInterval : unused_interval_ * absl::Uniform(random_, 0.5, 1.5),
             follows_.load(std::memory_order_relaxed));
}

absl::Status HeadLogStore::Connect() {
  if (client_ != nullptr && client_->is_usable()) return absl::OkStatus();
  auto connected = RedisClient::Connect(options_);
  if (connected.ok()) client_ = *std::move(connected);
  return connected.status();
}

}  // namespace spikeserve
