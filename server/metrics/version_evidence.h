// Counts what the sessions of one policy version do while a roll-out compares it with another one.
//
//   VersionEvidence evidence;
//   evidence.Watch({});
//   evidence.CountEpisode(/*episode_return=*/500.0);
//   const VersionEvidence::Counts counts = evidence.Read();
//
// Thread-safe. While nothing watches, each Count...() costs one atomic load.
#ifndef SERVER_METRICS_VERSION_EVIDENCE_H_
#define SERVER_METRICS_VERSION_EVIDENCE_H_

#include <array>
#include <atomic>
#include <cstdint>
#include <string>

#include "absl/base/thread_annotations.h"
#include "absl/container/flat_hash_set.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"

namespace spikeserve {

// A histogram of durations with a resolution of 9 %, from 1 us to 16 s.
class DurationCounts {
 public:
  static constexpr int kBuckets = 192;

  // Returns the bucket of a duration.
  static int BucketOf(double seconds);

  void Add(int bucket, int64_t count) { counts_[static_cast<size_t>(bucket)] += count; }
  int64_t total() const;
  // Returns the upper end, in seconds, of the bucket with the given quantile. 0 without durations.
  double Quantile(double quantile) const;
  // Returns how many durations were surely longer than `seconds`.
  int64_t CountAbove(double seconds) const;

 private:
  std::array<int64_t, kBuckets> counts_ = {};
};

class VersionEvidence {
 public:
  struct Counts {
    int64_t sessions = 0;
    int64_t failed_sessions = 0;  // in which a decision was refused or failed
    int64_t episodes = 0;
    double return_mean = 0.0;
    double return_squares = 0.0;  // sum of squared deviations from the mean (Welford)
    DurationCounts durations = {};

    // Variance of one episode's return.
    double return_variance() const {
      return episodes < 2 ? 0.0 : return_squares / static_cast<double>(episodes - 1);
    }
  };

  // Starts to count, from `start`.
  void Watch(const Counts& start);
  // Stops to count; the counts stay readable.
  void Stop() { watched_.store(false, std::memory_order_relaxed); }

  void CountSession();
  // Counts a session once, however often it fails. Remembers at most kMostFailed sessions.
  void CountFailure(absl::string_view session_id);
  void CountEpisode(double episode_return);
  void CountDecision(double compute_seconds);

  Counts Read() const;

 private:
  static constexpr size_t kMostFailed = 100'000;

  bool watched() const { return watched_.load(std::memory_order_relaxed); }

  std::atomic<bool> watched_ = false;
  std::array<std::atomic<int64_t>, DurationCounts::kBuckets> durations_ = {};
  mutable absl::Mutex mutex_;
  Counts counts_ ABSL_GUARDED_BY(mutex_);  // without durations
  absl::flat_hash_set<std::string> failed_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve

#endif  // SERVER_METRICS_VERSION_EVIDENCE_H_
