#include "server/metrics/version_evidence.h"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace spikeserve {
namespace {

constexpr double kShortest = 1e-6;  // seconds; the lower end of the first bucket
constexpr double kPerOctave = 8.0;  // buckets

double LowerEnd(int bucket) {
  return kShortest * std::exp2(static_cast<double>(bucket) / kPerOctave);
}

}  // namespace

int DurationCounts::BucketOf(double seconds) {
  const double place = kPerOctave * std::log2(std::max(seconds, kShortest) / kShortest);
  return std::min(static_cast<int>(place), kBuckets - 1);
}

int64_t DurationCounts::total() const {
  return std::accumulate(counts_.begin(), counts_.end(), int64_t{0});
}

double DurationCounts::Quantile(double quantile) const {
  const double rank = quantile * static_cast<double>(total());
  int64_t below = 0;
  for (int bucket = 0; bucket < kBuckets; ++bucket) {
    below += counts_[static_cast<size_t>(bucket)];
    if (below > 0 && static_cast<double>(below) >= rank) return LowerEnd(bucket + 1);
  }
  return 0.0;
}

int64_t DurationCounts::CountAbove(double seconds) const {
  int64_t above = 0;
  for (int bucket = kBuckets - 1; bucket >= 0 && LowerEnd(bucket) >= seconds; --bucket) {
    above += counts_[static_cast<size_t>(bucket)];
  }
  return above;
}

void VersionEvidence::Watch(const Counts& start) {
  absl::MutexLock lock(&mutex_);
  counts_ = start;
  failed_.clear();
  for (std::atomic<int64_t>& count : durations_) count.store(0, std::memory_order_relaxed);
  watched_.store(true, std::memory_order_relaxed);
}

void VersionEvidence::CountSession() {
  if (!watched()) return;
  absl::MutexLock lock(&mutex_);
  ++counts_.sessions;
}

void VersionEvidence::CountFailure(absl::string_view session_id) {
  if (!watched()) return;
  absl::MutexLock lock(&mutex_);
  if (failed_.size() < kMostFailed && failed_.emplace(session_id).second) {
    ++counts_.failed_sessions;
  }
}

void VersionEvidence::CountEpisode(double episode_return) {
  if (!watched()) return;
  absl::MutexLock lock(&mutex_);
  ++counts_.episodes;
  const double before = episode_return - counts_.return_mean;
  counts_.return_mean += before / static_cast<double>(counts_.episodes);
  counts_.return_squares += before * (episode_return - counts_.return_mean);
}

void VersionEvidence::CountDecision(double compute_seconds) {
  if (!watched()) return;
  const auto bucket = static_cast<size_t>(DurationCounts::BucketOf(compute_seconds));
  durations_[bucket].fetch_add(1, std::memory_order_relaxed);
}

VersionEvidence::Counts VersionEvidence::Read() const {
  absl::MutexLock lock(&mutex_);
  Counts counts = counts_;
  for (int bucket = 0; bucket < DurationCounts::kBuckets; ++bucket) {
    const auto& count = durations_[static_cast<size_t>(bucket)];
    counts.durations.Add(bucket, count.load(std::memory_order_relaxed));
  }
  return counts;
}

}  // namespace spikeserve
