// The times of a robot's end of a session, which has no clock of its own.
#pragma once

#include <chrono>

namespace spikeserve::robot {

// Since a fixed point in the past, or between two points.
using Time = std::chrono::nanoseconds;

inline constexpr Time kLongAgo = -std::chrono::hours(24 * 365 * 100);
inline constexpr Time kNever = std::chrono::hours(24 * 365 * 100);

// A point in time by two clocks.
struct Now {
  Time steady;  // monotonic: for waits
  Time robot;   // also counts the time in which the computer was suspended: for ages
};

}  // namespace spikeserve::robot
