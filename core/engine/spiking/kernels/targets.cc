#include "core/engine/spiking/kernels/targets.h"

#define HWY_WANT_AVX3_DL 1
#include "hwy/highway.h"

namespace spikeserve::kernels {

std::vector<std::string> SupportedTargets() {
  std::vector<std::string> names;
  for (const int64_t target : hwy::SupportedAndGeneratedTargets()) {
    names.emplace_back(hwy::TargetName(target));
  }
  return names;
}

void ForceTargetForTest(const std::string& name) {
  hwy::SetSupportedTargetsForTest(0);
  if (name.empty()) return;
  for (const int64_t target : hwy::SupportedAndGeneratedTargets()) {
    if (name == hwy::TargetName(target)) return hwy::SetSupportedTargetsForTest(target);
  }
}

}  // namespace spikeserve::kernels
