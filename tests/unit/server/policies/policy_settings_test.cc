#include "server/policies/policy_settings.h"

#include <gtest/gtest.h>

#include <string>

#include "tests/support/files.h"

namespace spikeserve {
namespace {

Settings SomeSettings() {
  Settings settings;
  settings.policies["cartpole"] = {
      .default_version = 1,
      .labels = {{"canary", 2}, {"stable", 1}},
      .shares = {{.version = 1, .percent = 95}, {.version = 2, .percent = 5}},
      .shadow_version = 3,
      .learning_paused = true,
      .rollout = Rollout{.version = 2,
                         .stable_version = 1,
                         .steps = {1, 100},
                         .hold_seconds = 0.5,
                         .min_episodes = 3,
                         .abort_if = {{RolloutMeasure::kErrors, 0.01}},
                         .state = RolloutState::kAborted,
                         .step = 1,
                         .held_seconds = 0.25,
                         .episodes_at_step = 7,
                         .started = 1.5,
                         .step_started = 2.5,
                         .ended = 3.5,
                         .reason = "worse",
                         .disputed = "one tenant",
                         .new_evidence = {{"", {1, 2, 3, 4, 5, 2, {{1, 4.5}, {2, 5.5}}}},
                                          {"fleet", {.sessions = 6}}},
                         .stable_evidence = {{"", {6, 7, 8, 9, 10, 0, {}}}}}};
  settings.policies["pendulum"] = {.default_follows_highest = true};
  settings.unloaded = {{.policy = "cartpole", .version = 4}};
  return settings;
}

TEST(PolicySettings, WhatIsWrittenIsRead) {
  const TemporaryDirectory directory;
  const std::string path = (directory.path() / "settings.json").string();
  const Settings written = SomeSettings();
  ASSERT_TRUE(WriteSettings(written, path).ok());
  const auto read = ReadSettings(path);
  ASSERT_TRUE(read.ok()) << read.status();
  EXPECT_EQ(read->policies, written.policies);
  EXPECT_EQ(read->unloaded, written.unloaded);
}

}  // namespace
}  // namespace spikeserve
