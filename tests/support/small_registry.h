// A policy registry that serves small random policies from a temporary directory, for tests of code
// that uses a registry.
#pragma once

#include <gtest/gtest.h>

#include <filesystem>
#include <initializer_list>
#include <memory>
#include <string>

#include "core/model/policy_file.h"
#include "server/metrics/metrics.h"
#include "server/policies/policy_registry.h"
#include "tests/support/files.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {

class SmallRegistry {
 public:
  // Serves version 1 of each policy in `names`.
  explicit SmallRegistry(std::initializer_list<std::string> names) {
    for (const std::string& name : names) WriteVersion(name, 1);
    ReloadReport report;
    auto registry = PolicyRegistry::Load(
        {.directory = directory_.path().string(),
         .loader = {.new_observer =
                        [this](const std::string& name, int64_t version, const Policy& loaded) {
                          return metrics_.NewPolicyObserver(name, version, loaded);
                        }}},
        &report);
    EXPECT_TRUE(registry.ok()) << registry.status();
    EXPECT_TRUE(report.refused.empty());
    registry_ = *std::move(registry);
  }

  PolicyRegistry* get() { return registry_.get(); }
  Metrics& metrics() { return metrics_; }

 private:
  void WriteVersion(const std::string& name, int64_t version) {
    const auto folder = directory_.path() / name / std::to_string(version);
    std::filesystem::create_directories(folder);
    const Policy policy =
        RandomPolicy(SmallConfig(), kObservationSize, ActionSpace::Discrete(2), /*seed=*/1);
    EXPECT_TRUE(WritePolicyFile(policy, (folder / "policy.safetensors").string()).ok());
  }

  TemporaryDirectory directory_;
  Metrics metrics_;
  std::unique_ptr<PolicyRegistry> registry_;
};

}  // namespace spikeserve
