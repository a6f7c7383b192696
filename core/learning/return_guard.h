// Watches the returns of a learning head and restores the last good head when they fall.
//
// The guard judges episodes in windows of kWindow. The level of a window is the interquartile mean
// of its returns, that is, the mean of their middle half. Outliers do not change it as long as they
// are less than a quarter of the returns. The error of a level is the standard error of a trimmed
// mean (Tukey & McLaughlin, Sankhya A 25, 1963). The reference is the level of the best window so
// far. The heads of the first window have changed little, so its level is that of the frozen
// policy. A window is bad if
//
//   level < reference - margin |reference| - 3 sqrt(error^2 + reference_error^2)
//
// The good head is the head at the start of the last window that was not bad, because that head and
// the heads that it developed into earned the returns of that window. After a bad window the guard
// restores the good head. If the next window is bad too, the environment itself has changed: the
// guard restores the head of the policy and measures a new reference.
//
// A plain value of constant size. Not thread-safe.
#ifndef CORE_LEARNING_RETURN_GUARD_H_
#define CORE_LEARNING_RETURN_GUARD_H_

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
  // many windows and so tends to be above the true level.
  static constexpr double kErrors = 3.0;

  std::vector<double> returns;  // of the running window
  Eigen::VectorXf beginning;    // [act * d]: W - W_base at the start of the running window
  Eigen::VectorXf good;         // [act * d]: W - W_base of the good head
  bool has_reference = false;
  WindowLevel reference;
  WindowLevel last;           // of the last window that ended; zero before the first
  bool on_probation = false;  // the last window was bad
  int64_t rollbacks = 0;

  // Returns a guard of a head with W - W_base = `delta`.
  static ReturnGuard New(const Eigen::VectorXf& delta);

  // Takes the return of an episode that has ended, and `delta`, the head after it. Returns true if
  // the guard restored an earlier head by writing it into `delta`.
  bool OnEpisode(double episode_return, double margin, Eigen::VectorXf* delta);

  // Continues from `delta`, to which another guard has restored the head: starts a new window.
  void OnRestored(const Eigen::VectorXf& delta);

 private:
  void RollBack(Eigen::VectorXf* delta);
};

// Returns the interquartile mean of `values` and its standard error. REQUIRES: at least 4 values.
WindowLevel InterquartileMean(absl::Span<const double> values);

}  // namespace spikeserve

#endif  // CORE_LEARNING_RETURN_GUARD_H_
