// Watches the returns of a learning head and restores an earlier head when they fall below what
// that head has earned.
//
// The guard judges episodes in windows of kWindow. The level of a window is the interquartile mean
// of its returns, that is, the mean of their middle half. Outliers do not change it as long as they
// are less than a quarter of the returns. The error of a level is the standard error of a trimmed
// mean (Tukey & McLaughlin, Sankhya A 25, 1963). The good head is the one to go back to, and the
// reference is its level. A window is bad if
//
//   level < reference - margin |reference| - 3 sqrt(error^2 + reference_error^2)
//
// The head between two windows becomes the good one if the later one, and both together, have
// earned at least the reference. Its own level is their mean: a head that learns fast earns less
// before it and more after it. That of the first head is taken from its first episodes.
// After a bad window the guard restores the good head, one step back, and measures it in the next
// window, in which it does not learn (`on_probation`): a reference that was luck, or that another
// environment has given, does not stay. Nothing else makes the guard give up what was learned.
//
// A head that operators teach (correction.h) changes in the episodes in which they act, and is
// judged by those that it plays alone: the last kAlone or more before, and the first kAlone after,
// then all kWindow. If the later ones are bad as above, the head before is on trial for kAlone
// episodes, and the better of the two stays. So a motor that failed while an operator helped is not
// held against what he taught, and an operator who spoils the head loses it soon after he has left.
//
// A plain value of constant size. Not thread-safe.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "Eigen/Core"
#include "absl/types/span.h"

namespace spikeserve {

// The level of one window of returns.
struct WindowLevel {
  double mean = 0.0;   // interquartile mean
  double error = 0.0;  // standard error of `mean`

  friend bool operator==(const WindowLevel&, const WindowLevel&) = default;
};

struct ReturnGuard {
  static constexpr size_t kWindow = 20;
  // Standard errors that a bad window falls short by. Three, because the reference is the best of
  // several windows and so tends to be above the true level.
  static constexpr double kErrors = 3.0;
  static constexpr size_t kAlone = 5;  // episodes that judge a head that operators teach

  std::vector<double> returns;  // of the running window
  // [act * d]: W - W_base at the start of the running window, or of the head that operators have
  // taught while that before is on trial.
  Eigen::VectorXf beginning;
  Eigen::VectorXf good;  // [act * d]: W - W_base of the good head
  bool has_reference = false;
  WindowLevel reference;
  WindowLevel last;           // of the last window that ended; zero before the first
  bool on_probation = false;  // the running window measures the good head, which was restored
  int64_t rollbacks = 0;

  // Returns a guard of a head with W - W_base = `delta`.
  static ReturnGuard New(const Eigen::VectorXf& delta);

  // Takes the return of an episode that has ended, and `delta`, the head after it. Returns true if
  // the guard restored the good head by writing it into `delta`. While `on_probation`, the caller
  // keeps the head as it is, if it can.
  bool OnEpisode(double episode_return, double margin, Eigen::VectorXf* delta);

  // For a head that operators teach, in the place of OnEpisode(): an operator is about to change
  // `delta` for the first time in an episode, or an episode has ended in which none acted. Returns
  // true if the head was replaced, by that before or after the trial.
  void OnTaught(const Eigen::VectorXf& delta);
  bool OnEpisodeAlone(double episode_return, double margin, Eigen::VectorXf* delta);

  // Continues from `delta`, to which another guard has restored the head: measures it.
  void OnRestored(const Eigen::VectorXf& delta);

 private:
  // Returns whether a window at this level is bad.
  bool IsBad(const WindowLevel& level, double margin) const;
  // Takes `returns` as what the head at `delta`, which operators teach, earns.
  void Settle(const Eigen::VectorXf& delta);
};

// Returns the interquartile mean of `values` and its standard error. REQUIRES: at least 4 values.
WindowLevel InterquartileMean(absl::Span<const double> values);

}  // namespace spikeserve
