// How the process of a training uses memory.
#pragma once

namespace spikeserve {

// Keeps freed memory instead of returning it to the kernel. Every iteration allocates the same
// large tensors, and page faults for new memory would take a fifth of its time. Call it in main().
void KeepFreedMemory();

}  // namespace spikeserve
