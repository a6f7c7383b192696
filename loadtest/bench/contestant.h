// One contestant of the benchmark: a process that measures itself in rounds.
//
// A driver (bench.py) starts all contestants and runs them in turn, so that a disturbance of the
// machine affects all of them equally. The contestant prints the line "ready" to standard output.
// Then each line on standard input, a number of seconds, is one round, which the contestant answers
// with one line of JSON: {"decisions": N, "seconds": S, "spikes": M}. S is processor time, which is
// not affected by other processes. The contestant exits at the end of its standard input.
#pragma once

#include <cstdint>
#include <functional>

namespace spikeserve {

// The work that one call did.
struct Work {
  int64_t decisions = 0;
  uint64_t spikes = 0;
};

// Runs the rounds; in each of them calls `decide` repeatedly until the time is over.
void RunContestant(const std::function<Work()>& decide);

}  // namespace spikeserve
