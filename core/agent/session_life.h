// Summarizes the whole life of a session in a bounded amount of memory, for operators.
//
//   SessionLife life(/*first_decision=*/0, /*first_episode=*/0);
//   life.OnDecision(/*since_open=*/absl::Seconds(2), /*spikes=*/130, /*seconds=*/4e-5);
//   for (const auto& [first, count, sum] : life.decisions()) ...
//
// Not thread-safe.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "absl/time/time.h"
#include "core/action/step_source.h"
#include "core/agent/help_signals.h"
#include "core/engine/counts.h"

namespace spikeserve {

// A series of sums over equally long runs of consecutive items. When the series is full, pairs of
// neighbours are added up, so that half of the points cover twice as many items each. `Sum` has a
// member function Add(const Sum&).
template <typename Sum>
class ThinnedSeries {
 public:
  static constexpr size_t kPoints = 24;

  struct Point {
    uint64_t first;  // index of the first item
    uint64_t count;  // number of items; all points but the last have equally many
    Sum sum;
  };

  // Indices start at `first`.
  explicit ThinnedSeries(uint64_t first) : first_(first) {}

  // Allocates memory at the first call only.
  void Add(const Sum& item) {
    if (sums_.empty()) sums_.reserve(kPoints);
    if (items_ % items_per_point_ != 0) {
      sums_.back().Add(item);
    } else {
      // The number of points is even, so the item still starts a point afterwards.
      if (sums_.size() == kPoints) Thin();
      sums_.push_back(item);
    }
    ++items_;
  }

  uint64_t items() const { return items_; }

  std::vector<Point> Points() const {
    std::vector<Point> points;
    for (size_t i = 0; i < sums_.size(); ++i) {
      const uint64_t before = i * items_per_point_;
      const uint64_t left = items_ - before;
      points.push_back(
          {first_ + before, left < items_per_point_ ? left : items_per_point_, sums_[i]});
    }
    return points;
  }

 private:
  void Thin() {
    for (size_t i = 0; i < kPoints / 2; ++i) {
      sums_[i] = sums_[2 * i];
      sums_[i].Add(sums_[2 * i + 1]);
    }
    sums_.resize(kPoints / 2);
    items_per_point_ *= 2;
  }

  uint64_t first_;
  uint64_t items_ = 0;
  uint64_t items_per_point_ = 1;
  std::vector<Sum> sums_;
};

class SessionLife {
 public:
  struct Decisions {
    float until;  // seconds from the start of this life to the last decision
    float spikes;
    float seconds;  // time to compute the decisions

    void Add(const Decisions& later) {
      until = later.until;
      spikes += later.spikes;
      seconds += later.seconds;
    }
  };
  struct Episodes {
    double episode_return;

    void Add(const Episodes& later) { episode_return += later.episode_return; }
  };

  // The life starts at the decision and the episode with these indices: after those that a restored
  // session made on another server.
  SessionLife(uint64_t first_decision, int64_t first_episode)
      : decisions_(first_decision), episodes_(static_cast<uint64_t>(first_episode)) {}

  // Counts a decision, `since_open` after the start of this life.
  void OnDecision(absl::Duration since_open, uint64_t spikes, double seconds) {
    decisions_.Add({.until = static_cast<float>(absl::ToDoubleSeconds(since_open)),
                    .spikes = static_cast<float>(spikes),
                    .seconds = static_cast<float>(seconds)});
  }
  // `expected` is the return that the policy was thought to reach; that of the episodes before is
  // expected, too, if it is more.
  void OnEpisode(double episode_return, double expected) {
    const double forecast = ended_episodes() == 0 ? expected : std::max(expected, mean_return());
    return_sum_ += episode_return;
    last_return_ = episode_return;
    help_.OnEpisode(forecast - episode_return);
    episodes_.Add({.episode_return = episode_return});
  }

  // The return of an episode has changed since.
  void OnAmended(double change, bool is_last) {
    return_sum_ += change;
    if (is_last) last_return_ += change;
  }

  void OnMissingRewards(int64_t rewards) { missing_rewards_ += rewards; }
  void OnSource(const StepSource& source) {
    last_source_ = source;
    ++steps_by_source_[static_cast<size_t>(source.kind)];
  }
  void OnCounts(const Counts& counts) { counts_ += counts; }
  HelpSignals& help() { return help_; }
  const HelpSignals& help() const { return help_; }

  // Returns the sum over the decisions of this life.
  const Counts& counts() const { return counts_; }

  // Returns the rewards after step 0 that were left out, and counted as 0.
  int64_t missing_rewards() const { return missing_rewards_; }
  // Returns who chose the last executed action that is known; nothing before the first one.
  const std::optional<StepSource>& last_source() const { return last_source_; }
  // Returns the number of steps by SourceKind.
  const std::array<uint64_t, kSourceKinds>& steps_by_source() const { return steps_by_source_; }
  std::vector<ThinnedSeries<Decisions>::Point> decisions() const { return decisions_.Points(); }
  std::vector<ThinnedSeries<Episodes>::Point> episodes() const { return episodes_.Points(); }

  uint64_t ended_episodes() const { return episodes_.items(); }
  // Returns of the ended episodes; 0 without one.
  double mean_return() const {
    return ended_episodes() == 0 ? 0.0 : return_sum_ / static_cast<double>(ended_episodes());
  }
  double last_return() const { return last_return_; }

 private:
  ThinnedSeries<Decisions> decisions_;
  ThinnedSeries<Episodes> episodes_;
  double return_sum_ = 0.0;
  double last_return_ = 0.0;
  int64_t missing_rewards_ = 0;
  std::optional<StepSource> last_source_;
  std::array<uint64_t, kSourceKinds> steps_by_source_ = {};
  Counts counts_;
  HelpSignals help_;
};

}  // namespace spikeserve
