// Watches what a head that learns earns, and puts back the last good one when it earns less.
//
// Episodes are judged in windows of kWindow. A window's level is the interquartile mean of its
// returns: the mean of their middle half, which less than a quarter of absurd returns cannot move.
// Its standard error is that of a trimmed mean (Tukey & McLaughlin, Sankhya A 25, 1963). The
// reference is the level of the best window so far; the first one, played by heads that have barely
// moved, is the frozen baseline. A window is bad when
//
//   level < reference - margin |reference| - 2 sqrt(error^2 + reference_error^2)
//
// The head that a good window began with is a good one: all that came of it was good. After a bad
// window the last good head comes back. Where that one has a bad window too, the world has changed:
// the policy's own head comes back, and the reference is measured anew.
//
// A plain value and part of what learns; constant in size. Not thread-safe.
#ifndef CORE_LEARNING_RETURN_GUARD_H_
#define CORE_LEARNING_RETURN_GUARD_H_

#include <cstddef>
#include <cstdint>
#include <vector>

#include "absl/types/span.h"

namespace spikeserve {

// Of one window of returns.
struct WindowLevel {
  double mean = 0.0;   // interquartile
  double error = 0.0;  // standard error of `mean`

  friend bool operator==(const WindowLevel&, const WindowLevel&) = default;
};

struct ReturnGuard {
  static constexpr size_t kWindow = 20;

  std::vector<double> returns;   // of the running window
  std::vector<float> beginning;  // W - W_base as the running window began
  std::vector<float> good;       // W - W_base as the last good window began
  bool has_reference = false;
  WindowLevel reference;
  WindowLevel last;           // of the last window that ended; 0 before
  bool on_probation = false;  // the last window was bad
  int64_t rollbacks = 0;

  // A guard of a head that stands at `delta`.
  static ReturnGuard New(const std::vector<float>& delta);

  // An episode ended with `episode_return`, and the head stands at `delta` after it. True where
  // `delta` was rolled back.
  bool OnEpisode(double episode_return, double margin, std::vector<float>* delta);

  friend bool operator==(const ReturnGuard&, const ReturnGuard&) = default;

 private:
  void RollBack(std::vector<float>* delta);
};

// REQUIRES: at least 4 values.
WindowLevel InterquartileMean(absl::Span<const double> values);

}  // namespace spikeserve

#endif  // CORE_LEARNING_RETURN_GUARD_H_
