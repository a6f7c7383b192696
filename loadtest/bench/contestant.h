// One contestant of the benchmark, as a process that measures itself in rounds.
//
// A driver (bench.py) starts many contestants and lets them run in turn, so that whatever slows the
// machine slows them all alike. After a line "ready" on standard output, each line with a number of
// seconds on standard input is a round, answered by one line of JSON:
// {"decisions": N, "seconds": S, "spikes": M}, S in processor time, which other processes on the
// machine do not lengthen. The contestant ends with its standard input.
#ifndef LOADTEST_BENCH_CONTESTANT_H_
#define LOADTEST_BENCH_CONTESTANT_H_

#include <cstdint>
#include <functional>

namespace spikeserve {

struct Work {
  int64_t decisions = 0;
  uint64_t spikes = 0;
};

// Answers rounds, in each of which `decide` is called until the time is over.
void RunContestant(const std::function<Work()>& decide);

}  // namespace spikeserve

#endif  // LOADTEST_BENCH_CONTESTANT_H_
