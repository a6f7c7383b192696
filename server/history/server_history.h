// Keeps the history of a server's metrics, and answers what the status page asks about it.
//
//   ServerHistory history([&] { return metrics.Collect(); }, &clock);
//   Periodic ticker(ServerHistory::kInterval, [&] { history.Tick(); });
//   nlohmann::json last_minute = history.Status(absl::Minutes(1));
//
// Thread-safe.
#pragma once

#include <cstdint>
#include <deque>
#include <functional>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "nlohmann/json.hpp"
#include "prometheus/metric_family.h"
#include "server/history/alerts.h"
#include "server/history/metric_history.h"

namespace spikeserve {

class ServerHistory {
 public:
  // The interval at which Tick is to be called.
  static constexpr absl::Duration kInterval = absl::Seconds(2);
  // The longest time that Over returns, and the largest number of points in it.
  static constexpr absl::Duration kLongest = absl::Minutes(30);
  static constexpr int kPoints = 120;

  using Collect = std::function<std::vector<prometheus::MetricFamily>()>;

  // Calls Tick. `clock` must outlive this object, and so must everything that `collect` uses.
  ServerHistory(Collect collect, const Clock* clock);

  // Adds the present metrics to the history and evaluates the alerts.
  void Tick() ABSL_LOCKS_EXCLUDED(mutex_);

  // Returns {"window_seconds", "figures", "versions", "calls", "alerts"} for the last `window`, at
  // most since the server started.
  nlohmann::json Status(absl::Duration window) const ABSL_LOCKS_EXCLUDED(mutex_);

  static constexpr size_t kMostPlaying = 8;
  // Returns what the status pages of other servers show about this one: {"sessions",
  // "decisions_per_second", "call_p99_seconds", "failed_ratio", "alerts_firing", "playing"} of the
  // last minute. "playing" names the first kMostPlaying of the versions that were not idle.
  nlohmann::json Summary() const ABSL_LOCKS_EXCLUDED(mutex_);

  // Returns {"step_seconds", "seconds_ago", "server", "versions"}: lists of figures over the last
  // `seconds`. Versions that were idle all the time are left out.
  nlohmann::json Over(absl::Duration seconds) const ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  // Returns the time of the last Tick at or before `time`, or of the first one that is remembered.
  absl::Duration TickBefore(absl::Duration time) const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Returns the labels of every policy version in memory.
  std::vector<MetricLabels> Versions() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const Collect collect_;
  const Clock* const clock_;
  mutable absl::Mutex mutex_;
  MetricHistory history_ ABSL_GUARDED_BY(mutex_);
  // The times of the last calls of Tick, as far back as Over looks, and the number of all calls.
  std::deque<absl::Duration> ticks_ ABSL_GUARDED_BY(mutex_);
  int64_t tick_count_ ABSL_GUARDED_BY(mutex_) = 0;
  Alerts alerts_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
