#include "server/metrics/version_evidence.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <numeric>
#include <random>
#include <utility>

namespace spikeserve {
namespace {

constexpr double kShortest = 1e-6;  // seconds; the lower end of the first bucket

// The durations of a session's first decisions count.
constexpr int64_t kMostDecisions = 1000;

// Returns the lower ends of the buckets and the upper end of the last one, in seconds. Each octave
// has the fractions of the first one, so the ends do not depend on the C library's functions.
constexpr std::array<double, DurationCounts::kBuckets + 1> LowerEnds() {
  constexpr std::array<double, 8> kFractions = {1.0,
                                                1.0905077326652577,
                                                1.189207115002721,
                                                1.2968395546510096,
                                                1.4142135623730951,
                                                1.5422108254079407,
                                                1.681792830507429,
                                                1.8340080864093424};
  std::array<double, DurationCounts::kBuckets + 1> ends = {};
  double octave = kShortest;
  for (size_t bucket = 0; bucket < ends.size(); ++bucket) {
    if (bucket != 0 && bucket % kFractions.size() == 0) octave *= 2.0;
    ends[bucket] = octave * kFractions[bucket % kFractions.size()];
  }
  return ends;
}

constexpr auto kLowerEnds = LowerEnds();

}  // namespace

int DurationCounts::BucketOf(double seconds) {
  const auto* const last = kLowerEnds.begin() + kBuckets;
  const auto* const after = std::upper_bound(kLowerEnds.begin() + 1, last, seconds);
  return static_cast<int>(after - kLowerEnds.begin()) - 1;
}

int64_t DurationCounts::total() const {
  return std::accumulate(counts_.begin(), counts_.end(), int64_t{0});
}

double DurationCounts::Quantile(double quantile) const {
  const double rank = quantile * static_cast<double>(total());
  int64_t below = 0;
  for (int bucket = 0; bucket < kBuckets; ++bucket) {
    below += counts_[static_cast<size_t>(bucket)];
    if (below > 0 && static_cast<double>(below) >= rank)
      return kLowerEnds[static_cast<size_t>(bucket) + 1];
  }
  return 0.0;
}

int64_t DurationCounts::CountAbove(double seconds) const {
  int64_t above = 0;
  for (int bucket = kBuckets - 1; bucket >= 0 && kLowerEnds[static_cast<size_t>(bucket)] >= seconds;
       --bucket) {
    above += counts_[static_cast<size_t>(bucket)];
  }
  return above;
}

void DurationCounts::Add(const DurationCounts& other) {
  for (int bucket = 0; bucket < kBuckets; ++bucket) {
    Add(bucket, other.counts_[static_cast<size_t>(bucket)]);
  }
}

PlausibleReturns PlausibleReturns::Of(const Policy& policy) {
  const auto middle = static_cast<double>(policy.return_offset);
  const double target = std::abs(static_cast<double>(policy.target_return) - middle);
  const double reach = kTimesTrained * std::max(static_cast<double>(policy.return_scale), target);
  if (reach == 0.0) return {};  // a policy that knows no range
  return {.low = middle - reach, .high = middle + reach};
}

// Outlives the roll-out as long as one of its sessions is open.
struct VersionEvidence::Comparison {
  struct Tenant {
    TenantCounts counts;          // without durations
    std::vector<int64_t> owners;  // numbers of the sessions that have counts.returns
    std::array<std::atomic<int64_t>, DurationCounts::kBuckets> durations = {};
  };

  Comparison(const Counts& start, int64_t most, const PlausibleReturns& range)
      : most_per_session(most), plausible(range) {
    absl::MutexLock lock(&mutex);
    for (const auto& [name, counts] : start) {
      tenants[name].counts = counts;
      tenants[name].owners.assign(counts.returns.size(), kNobody);
    }
  }

  // Returns the place of a session that has its first return, or kNoPlace. The places are a
  // reservoir (Vitter, "Random sampling with a reservoir", 1985): all sessions are equally likely
  // to have one.
  size_t TakePlace(Tenant& tenant, int64_t session) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex) {
    std::vector<SessionReturn>& returns = tenant.counts.returns;
    const auto place = static_cast<size_t>(tenant.counts.returning++);
    if (returns.size() < kMostSampled) {
      returns.emplace_back();
      tenant.owners.push_back(session);
      return returns.size() - 1;
    }
    const size_t drawn = std::uniform_int_distribution<size_t>(0, place)(random);
    if (drawn >= returns.size()) return kNoPlace;
    returns[drawn] = {};
    tenant.owners[drawn] = session;
    return drawn;
  }

  static constexpr int64_t kNobody = 0;
  static constexpr size_t kNoPlace = std::numeric_limits<size_t>::max();

  const int64_t most_per_session;
  const PlausibleReturns plausible;
  std::atomic<bool> over = false;
  absl::Mutex mutex;
  std::map<std::string, Tenant> tenants ABSL_GUARDED_BY(mutex);  // never erased
  int64_t sessions ABSL_GUARDED_BY(mutex) = 0;                   // that were numbered, from 1
  int64_t step ABSL_GUARDED_BY(mutex) = 0;
  std::mt19937_64 random ABSL_GUARDED_BY(mutex);
};

class VersionEvidence::Session final : public SessionListener {
 public:
  Session(std::shared_ptr<Comparison> comparison, Comparison::Tenant* tenant, int64_t number)
      : comparison_(std::move(comparison)), tenant_(*tenant), number_(number) {}

  void OnDecision(const spikeserve::Session& session, const DecisionInputs& inputs) override {
    if (inputs.is_beat) return;
    if (comparison_->over.load(std::memory_order_relaxed)) return;
    if (decisions_++ == 0) CountSession();
    // A session that decides all the time does not hide the others.
    if (decisions_ > kMostDecisions) return;
    const auto bucket =
        static_cast<size_t>(DurationCounts::BucketOf(session.last_answer->compute_seconds));
    tenant_.durations[bucket].fetch_add(1, std::memory_order_relaxed);
  }

  void OnFailure() override {
    if (comparison_->over.load(std::memory_order_relaxed) || std::exchange(failed_, true)) return;
    if (decisions_ == 0) CountSession();
    ++decisions_;
    absl::MutexLock lock(&comparison_->mutex);
    ++tenant_.counts.failed_sessions;
  }

  bool OnEpisodeEnd(const spikeserve::Session& session,
                    const std::shared_ptr<FleetContribution>& /*contribution*/) override {
    const EpisodeSummary& summary = session.last_end->summary;
    if (!summary.awaits_verdict) CountReturn(summary.episode_return);
    return false;
  }
  bool OnVerdict(const spikeserve::Session& session,
                 const std::shared_ptr<FleetContribution>& /*contribution*/) override {
    CountReturn(session.verdicts.back().episode_return);
    return false;
  }

 private:
  void CountReturn(double episode_return) {
    if (comparison_->over.load(std::memory_order_relaxed)) return;
    absl::MutexLock lock(&comparison_->mutex);
    TenantCounts& counts = tenant_.counts;
    if (!comparison_->plausible.Contain(episode_return)) {
      ++counts.implausible;
      return;
    }
    ++counts.episodes;
    if (std::exchange(step_, comparison_->step) != comparison_->step) in_step_ = 0;
    if (in_step_++ < comparison_->most_per_session) ++counts.capped_episodes;
    ++returns_.episodes;
    returns_.mean += (episode_return - returns_.mean) / static_cast<double>(returns_.episodes);
    if (returns_.episodes == 1) place_ = comparison_->TakePlace(tenant_, number_);
    const bool has_place = place_ != Comparison::kNoPlace && tenant_.owners[place_] == number_;
    if (has_place) counts.returns[place_] = returns_;
  }

  void CountSession() {
    absl::MutexLock lock(&comparison_->mutex);
    ++tenant_.counts.sessions;
  }

  const std::shared_ptr<Comparison> comparison_;
  Comparison::Tenant& tenant_;  // of `comparison_`, whose lock guards it except its durations
  const int64_t number_;
  int64_t decisions_ = 0;
  bool failed_ = false;
  int64_t step_ = 0;
  int64_t in_step_ = 0;  // episodes
  SessionReturn returns_;
  size_t place_ = Comparison::kNoPlace;
};

void VersionEvidence::Watch(const Counts& start, int64_t most_per_session,
                            const PlausibleReturns& plausible) {
  Stop();
  absl::MutexLock lock(&mutex_);
  comparison_ = std::make_shared<Comparison>(start, most_per_session, plausible);
  watched_.store(true, std::memory_order_relaxed);
}

void VersionEvidence::NextStep() {
  absl::MutexLock lock(&mutex_);
  if (comparison_ == nullptr) return;
  absl::MutexLock counts_lock(&comparison_->mutex);
  ++comparison_->step;
}

void VersionEvidence::Stop() {
  watched_.store(false, std::memory_order_relaxed);
  absl::MutexLock lock(&mutex_);
  if (comparison_ != nullptr) comparison_->over.store(true, std::memory_order_relaxed);
}

std::shared_ptr<SessionListener> VersionEvidence::NewSession(absl::string_view tenant) {
  if (!watched_.load(std::memory_order_relaxed)) return nullptr;
  absl::MutexLock lock(&mutex_);
  if (comparison_ == nullptr) return nullptr;
  absl::MutexLock counts_lock(&comparison_->mutex);
  return std::make_shared<Session>(comparison_, &comparison_->tenants[std::string(tenant)],
                                   ++comparison_->sessions);
}

VersionEvidence::Counts VersionEvidence::Read() const {
  Counts counts;
  absl::MutexLock lock(&mutex_);
  if (comparison_ == nullptr) return counts;
  absl::MutexLock counts_lock(&comparison_->mutex);
  for (const auto& [name, tenant] : comparison_->tenants) {
    TenantCounts& copy = counts[name] = tenant.counts;
    copy.durations = {};
    for (int bucket = 0; bucket < DurationCounts::kBuckets; ++bucket) {
      const auto& count = tenant.durations[static_cast<size_t>(bucket)];
      copy.durations.Add(bucket, count.load(std::memory_order_relaxed));
    }
  }
  return counts;
}

}  // namespace spikeserve
