// Lists and selects the SIMD targets of the kernels, for tests and for reporting what a server runs
// on.
#pragma once

#include <string>
#include <vector>

namespace spikeserve::kernels {

// Returns the names of the targets that this processor supports, best first. The last one is
// EMU128, which is plain C++. The first one is in use unless a test forces another.
std::vector<std::string> SupportedTargets();

// Makes every kernel run on the best target, unless a target is chosen. Every engine calls it
// before it runs a kernel. Thread-safe.
void ChooseTarget();

// Makes every kernel run on the target `name`, or on the best target again if `name` is empty or
// not supported. Returns whether the kernels run on what was asked for. For tests only. Not
// thread-safe: no other thread may run a kernel during the call.
[[nodiscard]] bool ForceTargetForTest(const std::string& name);

}  // namespace spikeserve::kernels
