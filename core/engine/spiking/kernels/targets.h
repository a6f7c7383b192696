// The SIMD targets of the kernels, for tests and for saying what a server runs on.
#ifndef CORE_ENGINE_SPIKING_KERNELS_TARGETS_H_
#define CORE_ENGINE_SPIKING_KERNELS_TARGETS_H_

#include <string>
#include <vector>

namespace spikeserve::kernels {

// Names of the targets this processor can run, best first; the first is the one in use.
std::vector<std::string> SupportedTargets();

// Lets every kernel run on the named target, or on the best again where `name` is empty. For tests:
// not to be called while another thread computes.
void ForceTargetForTest(const std::string& name);

}  // namespace spikeserve::kernels

#endif  // CORE_ENGINE_SPIKING_KERNELS_TARGETS_H_
