#include "core/engine/spiking/kernels/targets.h"

#include <atomic>

#include "hwy/highway.h"

#if HWY_ARCH_ARM_A64
#include <sys/auxv.h>
#endif

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

constexpr char kNeonSdot[] = "NEON_SDOT";

bool HasSdot() {
#if HWY_ARCH_ARM_A64
  constexpr unsigned long kDotProducts = 1UL << 20;  // HWCAP_ASIMDDP of <asm/hwcap.h>
  static const bool has = (getauxval(AT_HWCAP) & kDotProducts) != 0;
  return has;
#else
  return false;
#endif
}

std::atomic<bool> sdot_allowed = true;

}  // namespace

bool UsesSdot() { return HasSdot() && sdot_allowed.load(std::memory_order_relaxed); }

std::vector<std::string> SupportedTargets() {
  std::vector<std::string> names;
  if (HasSdot()) names.emplace_back(kNeonSdot);
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
  const bool sdot = name == kNeonSdot && HasSdot();
  sdot_allowed.store(sdot || name.empty(), std::memory_order_relaxed);
  for (int64_t targets = Supported(); targets != 0; targets &= targets - 1) {
    const int64_t target = targets & -targets;
    const bool named = name == hwy::TargetName(target);
    if (!named && !(sdot && target == HWY_STATIC_TARGET)) continue;
    hwy::GetChosenTarget().Update(target);
    return true;
  }
  hwy::GetChosenTarget().Update(Supported());
  sdot_allowed.store(true, std::memory_order_relaxed);
  return name.empty();
}

}  // namespace spikeserve::kernels
