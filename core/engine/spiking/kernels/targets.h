// Lists and selects the SIMD targets of the kernels, for tests and for reporting what a server runs
// on.
#ifndef CORE_ENGINE_SPIKING_KERNELS_TARGETS_H_
#define CORE_ENGINE_SPIKING_KERNELS_TARGETS_H_

#include <string>
#include <vector>

namespace spikeserve::kernels {

// Returns the names of the targets that this processor supports, best first. The first one is in
// use unless a test forces another.
std::vector<std::string> SupportedTargets();

// Makes every kernel run on the target `name`, or on the best target again if `name` is empty. For
// tests only. Not thread-safe: no other thread may run a kernel during the call.
void ForceTargetForTest(const std::string& name);

}  // namespace spikeserve::kernels

#endif  // CORE_ENGINE_SPIKING_KERNELS_TARGETS_H_
