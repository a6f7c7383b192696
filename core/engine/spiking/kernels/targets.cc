#include "core/engine/spiking/kernels/targets.h"

#include "hwy/highway.h"

namespace spikeserve::kernels {
namespace {

// Returns the targets that this processor has and that the kernels are compiled for: always EMU128,
// which Highway names nowhere, and the static target, which the compiler may use everywhere.
int64_t Supported() {
#if HWY_ARCH_ARM_A64
  // Highway 1.0 names NEON only where the processor also has AES, which the kernels do not use. On
  // others, such as a Raspberry Pi 4, it prints a warning whenever it is asked.
  return (HWY_STATIC_TARGET | HWY_EMU128) & HWY_TARGETS;
#else
  return (hwy::SupportedTargets() | HWY_STATIC_TARGET | HWY_EMU128) & HWY_TARGETS;
#endif
}

}  // namespace

std::vector<std::string> SupportedTargets() {
  std::vector<std::string> names;
  for (int64_t targets = Supported(); targets != 0; targets &= targets - 1) {
    names.emplace_back(hwy::TargetName(targets & -targets));
  }
  return names;
}

void ChooseTarget() {
  hwy::ChosenTarget& chosen = hwy::GetChosenTarget();
  if (!chosen.IsInitialized()) chosen.Update(Supported());
}

bool ForceTargetForTest(const std::string& name) {
  for (int64_t targets = Supported(); targets != 0; targets &= targets - 1) {
    const int64_t target = targets & -targets;
    if (name != hwy::TargetName(target)) continue;
    hwy::GetChosenTarget().Update(target);
    return true;
  }
  hwy::GetChosenTarget().Update(Supported());
  return name.empty();
}

}  // namespace spikeserve::kernels
