// The settings of operators: every text is refused with a reason, or means the same when it is
// written and read again.
#include "server/policies/policy_settings.h"
#include "tests/fuzz/fuzz_target.h"

namespace spikeserve {

void FuzzOne(absl::string_view input) {
  const auto settings = ParseSettings(input);
  if (!settings.ok()) {
    FUZZ_CHECK(!settings.status().message().empty());
    return;
  }
  const auto again = ParseSettings(ToJson(*settings));
  FUZZ_CHECK(again.ok());
  FUZZ_CHECK(again->policies == settings->policies);
  FUZZ_CHECK(again->unloaded == settings->unloaded);
}

std::vector<std::string> Seeds() {
  PolicySettings policy;
  policy.default_version = 2;
  policy.labels = {{"stable", 1}, {"canary", 2}};
  policy.shares = {{.version = 1, .percent = 90}, {.version = 2, .percent = 10}};
  policy.shadow_version = 3;
  Settings settings;
  settings.policies["cartpole"] = policy;
  settings.unloaded = {{.policy = "cartpole", .version = 4}};
  return {ToJson(settings), ToJson({}), R"({"policies": {"cartpole": {}}})"};
}

}  // namespace spikeserve
