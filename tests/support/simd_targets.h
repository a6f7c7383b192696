// Runs tests on every SIMD target of the engine's kernels. A test that ran on none fails.
#pragma once

#include <gtest/gtest.h>

#include <algorithm>
#include <iostream>
#include <string>
#include <vector>

#include "core/engine/spiking/kernels/targets.h"

namespace spikeserve {

// The target in plain C++, which every processor has.
inline constexpr char kPortableTarget[] = "EMU128";

// Calls check() once for each target of this processor, which is in use during the call, and prints
// the names of the targets. Stops at the first target that fails. Fails if the portable target is
// not among them.
template <class Check>
void OnEverySimdTarget(Check check) {
  std::vector<std::string> ran;
  for (const std::string& target : kernels::SupportedTargets()) {
    SCOPED_TRACE("SIMD target " + target);
    ASSERT_TRUE(kernels::ForceTargetForTest(target));
    check();
    ran.push_back(target);
    if (testing::Test::HasFailure()) break;
  }
  EXPECT_TRUE(kernels::ForceTargetForTest(""));
  std::cout << "SIMD targets:";
  for (const std::string& target : ran) std::cout << ' ' << target;
  std::cout << '\n';
  if (testing::Test::HasFailure()) return;
  EXPECT_EQ(std::count(ran.begin(), ran.end(), kPortableTarget), 1)
      << "targets: expected the portable target among them, received " << ran.size() << " others";
}

}  // namespace spikeserve
