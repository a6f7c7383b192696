// Tests whether one of two versions is worse, again and again while evidence arrives.
//
// A mixture sequential probability ratio test (Robbins, "Statistical methods related to the law of
// the iterated logarithm", 1970; for comparisons that are watched all the time: Johari, Pekelis and
// Walsh, "Always valid inference: continuous monitoring of A/B tests", 2022). A test that is looked
// at every second must not use the threshold of a test that is looked at once: sooner or later
// chance would exceed it. This one may be looked at any number of times: if the new version is not
// worse, the probability that the ratio ever reaches 1/alpha is at most alpha, as far as the means
// are normal, which they are for many observations. For few, bets decide as well.
//
// Pure functions; safe to call from many threads.
#pragma once

#include <cstdint>

#include "absl/types/span.h"

namespace spikeserve {

// Two samples that are compared.
struct Comparison {
  double difference = 0.0;    // by how much the mean of the new version is worse, less the margin
  double new_variance = 0.0;  // of one observation
  double stable_variance = 0.0;
  int64_t new_count = 0;  // observations
  int64_t stable_count = 0;
};

// The fewest observations of each version, because variances are estimated from them.
inline constexpr int64_t kFewestObservations = 20;

// Returns the logarithm of the likelihood ratio between "the new version is worse" and "it is not".
// Under the former, the difference in standard deviations is half-normal with scale 0.5. Returns
// minus infinity with fewer than kFewestObservations on a side. If neither side varies, a variance
// of (`scale` / 1000)^2 is assumed; `scale` is the size of typical observations.
double LogWorseRatio(const Comparison& comparison, double scale);

// `count` observations with the same value, in [0, 1].
struct ObservedValue {
  double value = 0.0;
  int64_t count = 1;
};

// As far as fewer observations of a version than these are compared, LogBettingRatio() has to
// agree, because their means need not be normal.
inline constexpr int64_t kFewestNormal = 100;

// Returns the logarithm of what bets have won that the mean of `fresh` is below the mean of
// `stable` by more than `margin` (Waudby-Smith and Ramdas, "Estimating means of bounded random
// variables by betting", 2024). If it is not, the probability that this ever reaches 1/alpha is at
// most alpha, for any number of observations in [0, 1] of any distribution. 0 without observations.
double LogBettingRatio(absl::Span<const ObservedValue> fresh,
                       absl::Span<const ObservedValue> stable, double margin);

}  // namespace spikeserve
