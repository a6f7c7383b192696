// Counts what the sessions of one policy version do while a roll-out compares it with another one.
//
//   VersionEvidence evidence;
//   evidence.Watch({}, /*most_per_session=*/4, PlausibleReturns::Of(policy));
//   agent.AddListener(evidence.NewSession("warehouse"));
//   const VersionEvidence::Counts counts = evidence.Read();
//
// Thread-safe; each listener is used by one thread at a time.
#pragma once

#include <array>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <limits>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "core/agent/session_listener.h"
#include "core/model/policy.h"

namespace spikeserve {

// A histogram of durations with a resolution of 9 %, from 1 us to 16 s.
class DurationCounts {
 public:
  static constexpr int kBuckets = 192;

  // Returns the bucket of a duration.
  static int BucketOf(double seconds);

  void Add(int bucket, int64_t count) { counts_[static_cast<size_t>(bucket)] += count; }
  void Add(const DurationCounts& other);
  int64_t total() const;
  // Returns the upper end, in seconds, of the bucket with the given quantile. 0 without durations.
  double Quantile(double quantile) const;
  // Returns how many durations were surely longer than `seconds`.
  int64_t CountAbove(double seconds) const;

 private:
  std::array<int64_t, kBuckets> counts_ = {};
};

// The returns that a policy can have earned; others are implausible.
struct PlausibleReturns {
  static constexpr double kTimesTrained = 10.0;
  double low = -std::numeric_limits<double>::infinity();
  double high = std::numeric_limits<double>::infinity();

  // Returns ten times the range for which the policy was trained, on either side of its middle:
  // return_offset and return_scale, or target_return if that lies further away.
  static PlausibleReturns Of(const Policy& policy);
  // Returns the width of the range for which the policy was trained; infinite if it knows none.
  double TrainedRange() const { return (high - low) / kTimesTrained; }
  bool Contain(double episode_return) const {
    return std::isfinite(episode_return) && episode_return >= low && episode_return <= high;
  }
};

// The plausible returns of one session.
struct SessionReturn {
  int64_t episodes = 0;
  double mean = 0.0;

  friend bool operator==(const SessionReturn&, const SessionReturn&) = default;
};

// What the sessions of one tenant did on a version, as far as a restart keeps it.
struct TenantEvidence {
  int64_t sessions = 0;         // that have decided, or should have
  int64_t failed_sessions = 0;  // in which the version has failed to decide
  int64_t episodes = 0;         // with plausible returns
  int64_t implausible = 0;      // episodes whose return is implausible
  int64_t capped_episodes = 0;  // of each session at most `most_per_session` in each step
  int64_t returning = 0;        // sessions with plausible returns, of which `returns` is a sample
  std::vector<SessionReturn> returns = {};

  friend bool operator==(const TenantEvidence&, const TenantEvidence&) = default;
};
using EvidenceByTenant = std::map<std::string, TenantEvidence>;

// Counts sessions by tenant, so that a judge can leave a tenant out. Each session counts alike,
// however many episodes it has.
class VersionEvidence {
 public:
  // At most this many sessions of a tenant are kept; they are a random sample of all.
  static constexpr size_t kMostSampled = 256;

  struct TenantCounts : TenantEvidence {
    DurationCounts durations = {};
  };
  using Counts = std::map<std::string, TenantCounts>;  // by tenant

  // Starts to count, from `start`, without its durations. One session gives at most
  // `most_per_session` episodes to the `capped_episodes` of one step.
  void Watch(const Counts& start, int64_t most_per_session, const PlausibleReturns& plausible);
  // Begins another step.
  void NextStep();
  // Stops to count; the counts stay readable.
  void Stop();

  // Returns what receives the evidence of a new session, or null if nothing watches. It may outlive
  // the roll-out; then it counts no more.
  std::shared_ptr<SessionListener> NewSession(absl::string_view tenant);

  Counts Read() const;

 private:
  struct Comparison;  // the counts of one roll-out
  class Session;

  std::atomic<bool> watched_ = false;
  mutable absl::Mutex mutex_;
  std::shared_ptr<Comparison> comparison_ ABSL_GUARDED_BY(mutex_);  // null: none yet
};

}  // namespace spikeserve
