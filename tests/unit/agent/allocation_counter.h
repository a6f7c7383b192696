// Counts the allocations of a thread. Linking it replaces operator new in the whole program.
// malloc, which Eigen calls directly, is counted in the objects that are linked with --wrap=malloc.
#pragma once

#include <cstdint>

namespace spikeserve {

// Returns the number of allocations of the calling thread since it started.
int64_t Allocations();

}  // namespace spikeserve
