// The metrics that the server exports to Prometheus.
//
//   Metrics metrics;
//   metrics.ObserveRpc(MethodNamed("Act"), absl::StatusCode::kOk, absl::Microseconds(80));
//   std::string page = metrics.ToText();
//
// Thread-safe. The time series of a policy version are created when its first session opens, so
// that a version without traffic costs next to nothing, and a decision looks nothing up.
#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/container/flat_hash_map.h"
#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/agent/served_policy.h"
#include "prometheus/counter.h"
#include "prometheus/family.h"
#include "prometheus/gauge.h"
#include "prometheus/histogram.h"
#include "prometheus/metric_family.h"
#include "prometheus/registry.h"
#include "server/base/method.h"
#include "server/metrics/policy_metrics.h"
#include "server/metrics/version_evidence.h"

namespace spikeserve {

// The outcome of recording one episode.
enum class RecordingOutcome { kWritten, kQueueFull, kWriteFailed, kStorageFull };
inline constexpr int kRecordingOutcomes = 4;

// Folders whose bytes tenants divide (shared_folder.h).
enum class StoredFolder { kRecordings, kPolicies };
inline constexpr int kStoredFolders = 2;

// By Chebyshev's inequality, at most 1 in 64 values of any distribution lies further than 8
// standard deviations from its mean, and of a normal distribution practically none.
inline constexpr double kUnusualDeviations = 8.0;

// Largest number of time series of unusual observations for one policy version.
inline constexpr int kUnusualSeries = 64;

class Metrics {
 public:
  Metrics();
  Metrics(const Metrics&) = delete;
  Metrics& operator=(const Metrics&) = delete;

  // Returns an observer that counts what the sessions of one policy version do. When the last
  // observer of a version is destroyed, the time series of the version are removed. The observer
  // must not outlive this object. Elements of observations further than `unusual_deviations`
  // standard deviations from the mean of the training data count as unusual; 0: none does.
  // `wiring` follows from verdicts about the wiring of sessions that ask for no response.
  std::shared_ptr<SessionObserver> NewPolicyObserver(
      const std::string& name, int64_t version, const Policy& policy,
      double unusual_deviations = kUnusualDeviations,
      WiringResponse wiring = WiringResponse::kCount);

  // Returns the evidence about one policy version that all its observers count into. It lives as
  // long as this object.
  VersionEvidence* EvidenceOf(const std::string& name, int64_t version);

  // Adds a function whose metrics Collect returns with the others: for metrics that are read from
  // other state. It must be safe to call as long as this object. To be called before Collect.
  void AddSource(std::function<std::vector<prometheus::MetricFamily>()> source) {
    sources_.push_back(std::move(source));
  }

  // Counts a response with NaN or infinity that was not sent, and logs it. `policy` may be empty.
  void CountNonFiniteAnswer(const std::string& policy);

  // Records the duration of one call. For ActStream and ModelStreamInfer: of one request. `policy`
  // is that of the session that decided; empty: none, or several. Each of the first 100 policies
  // that decide has series of its own, which begin with its first call.
  void ObserveRpc(const Method& method, absl::StatusCode code, absl::Duration duration,
                  absl::string_view policy = "");

  // Counts sessions that were closed because they were idle for the time-to-live.
  void CountReaped(int64_t sessions) { reaped_idle_.Increment(static_cast<double>(sessions)); }

  void CountRecordedEpisode(RecordingOutcome outcome) {
    recorded_episodes_[static_cast<size_t>(outcome)]->Increment();
  }

  // Changes the gauges of the episodes that wait to be written.
  void AddRecordingQueue(int64_t episodes, int64_t bytes) {
    recording_queue_episodes_.Increment(static_cast<double>(episodes));
    recording_queue_bytes_.Increment(static_cast<double>(bytes));
  }

  // Exports the bytes in a folder, and their limit.
  void SetStoredBytes(StoredFolder folder, int64_t bytes, int64_t limit) {
    const auto i = static_cast<size_t>(folder);
    stored_bytes_[i]->Set(static_cast<double>(bytes));
    stored_bytes_limit_[i]->Set(static_cast<double>(limit));
  }

  // Exports the limit on open sessions.
  void SetSessionsLimit(int64_t sessions) { sessions_limit_.Set(static_cast<double>(sessions)); }

  // Keeps the time series of versions whose observers end from now on. To be called when the server
  // ends: to remove a series takes time in proportion to those that there are, and with a thousand
  // versions all of them took a minute.
  void KeepSeries() ABSL_LOCKS_EXCLUDED(versions_mutex_);

  // Returns the registry, for metrics that other classes own. Those classes must not outlive this
  // object.
  prometheus::Registry& registry() { return registry_; }

  // Returns all metrics, including those of CollectProcessMetrics.
  std::vector<prometheus::MetricFamily> Collect() const;
  // As Collect, in the text format of Prometheus.
  std::string ToText() const;

 private:
  static constexpr int kCodes = 17;  // gRPC status codes
  static constexpr size_t kMostPolicies = 100;

  // The histograms of calls, by AllMethods() and code; null: not yet created.
  using RpcDurations = std::vector<std::array<std::atomic<prometheus::Histogram*>, kCodes>>;

  // Returns the histograms of the calls of a policy; null if it has none of its own.
  RpcDurations* DurationsOf(absl::string_view policy) ABSL_LOCKS_EXCLUDED(policies_mutex_);

  // The time series of one policy version.
  struct VersionSeries {
    int observers = 0;
    std::map<const void*, std::function<void()>> removals;  // by series
  };
  // What the time series of a policy version are made from.
  struct PolicySeries {
    prometheus::Labels labels;
    ModelConfig config;
    std::vector<std::string> elements;  // of the observation; see ElementNames
    std::vector<Feature> features;      // the names of the elements; empty: none
    bool checks_wiring = false;
    std::array<std::optional<double>, kEnergyModels> dense_energy;
  };

  struct Adder;

  // Add the series of the sessions, of the robots and of the operators of a version, which has an
  // observer.
  PolicyMetrics::Handles AddSessions(const std::string& version, const PolicySeries& of)
      ABSL_LOCKS_EXCLUDED(versions_mutex_);
  static void AddWork(const Adder& add, const PolicySeries& of, PolicyMetrics::Handles* handles);
  static void AddUnusual(const Adder& add, const PolicySeries& of, PolicyMetrics::Handles* handles);
  static void AddLearning(const Adder& add, PolicyMetrics::Handles* handles);
  RobotHandles AddRobots(const std::string& version, const prometheus::Labels& labels)
      ABSL_LOCKS_EXCLUDED(versions_mutex_);
  SeatHandles AddSeats(const std::string& version, const prometheus::Labels& labels)
      ABSL_LOCKS_EXCLUDED(versions_mutex_);
  void OnObserverEnd(const std::string& version) ABSL_LOCKS_EXCLUDED(versions_mutex_);

  auto& Register(auto builder, const char* name, const char* help) {
    return builder.Name(name).Help(help).Register(registry_);
  }

  std::vector<std::function<std::vector<prometheus::MetricFamily>()>> sources_;
  absl::Mutex evidence_mutex_;
  std::map<std::pair<std::string, int64_t>, std::unique_ptr<VersionEvidence>> evidence_
      ABSL_GUARDED_BY(evidence_mutex_);

  prometheus::Registry registry_;  // owns everything below
  prometheus::Family<prometheus::Counter>& non_finite_;
  prometheus::Family<prometheus::Histogram>& rpc_duration_;
  prometheus::Counter& reaped_idle_;
  prometheus::Gauge& sessions_limit_;
  prometheus::Gauge& recording_queue_episodes_;
  prometheus::Gauge& recording_queue_bytes_;
  std::array<prometheus::Counter*, kRecordingOutcomes> recorded_episodes_;
  std::array<prometheus::Gauge*, kStoredFolders> stored_bytes_;
  std::array<prometheus::Gauge*, kStoredFolders> stored_bytes_limit_;
  absl::Mutex versions_mutex_;
  bool keeps_series_ ABSL_GUARDED_BY(versions_mutex_) = false;
  std::map<std::string, VersionSeries> versions_
      ABSL_GUARDED_BY(versions_mutex_);  // by name/number

  // Created when a method first returns a code, because most pairs never occur.
  RpcDurations rpc_durations_;
  absl::Mutex policies_mutex_;
  absl::flat_hash_map<std::string, std::unique_ptr<RpcDurations>> policy_durations_
      ABSL_GUARDED_BY(policies_mutex_);
};

}  // namespace spikeserve
