// Counts what a thread allocates. Linking it replaces operator new in the whole program.
#ifndef TESTS_UNIT_SESSION_ALLOCATION_COUNTER_H_
#define TESTS_UNIT_SESSION_ALLOCATION_COUNTER_H_

#include <cstdint>

namespace spikeserve {

// Allocations of the calling thread since it started.
int64_t Allocations();

}  // namespace spikeserve

#endif  // TESTS_UNIT_SESSION_ALLOCATION_COUNTER_H_
