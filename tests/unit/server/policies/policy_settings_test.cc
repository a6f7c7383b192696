#include "server/policies/policy_settings.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "tests/support/temporary_directory.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::IsEmpty;
using ::testing::StartsWith;

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
                         .new_evidence = {{"", {1, 2, 3, 4, 5, 2, {1, 2}, {4.5, 5.5}}},
                                          {"fleet", {.sessions = 6}}},
                         .stable_evidence = {{"", {6, 7, 8, 9, 10, 0, {}, {}}}}}};
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

TEST(PolicySettings, SettingsOfVersionsThatAreNotServedArePending) {
  const PolicySettings settings = SomeSettings().policies["cartpole"];
  std::vector<std::string> pending;
  PolicySettings effective = EffectiveSettings(settings, {1, 2, 3}, &pending);
  EXPECT_EQ(effective, settings);
  EXPECT_THAT(pending, IsEmpty());

  effective = EffectiveSettings(settings, {1}, &pending);
  EXPECT_EQ(effective.default_version, 1);
  EXPECT_THAT(effective.labels, ElementsAre(std::pair("stable", 1)));
  EXPECT_THAT(effective.shares, IsEmpty()) << "shares are pending together";
  EXPECT_EQ(effective.shadow_version, 0);
  EXPECT_TRUE(effective.learning_paused);
  EXPECT_THAT(pending, ElementsAre(StartsWith("labels.canary: "), StartsWith("shares: "),
                                   StartsWith("shadow_version: ")));
}

TEST(PolicySettings, TheUseOfAVersionIsNamed) {
  const PolicySettings settings = SomeSettings().policies["cartpole"];
  EXPECT_EQ(settings.DescribeUse(1), "the default");
  EXPECT_EQ(settings.DescribeUse(2), "label canary");
  EXPECT_EQ(settings.DescribeUse(3), "the shadow");
  EXPECT_EQ(settings.DescribeUse(4), "");
  EXPECT_EQ(settings.DescribeUseBesideDefault(1), "label stable");
  EXPECT_EQ(settings.PercentOf(2), 5);
  EXPECT_EQ(settings.PercentOf(3), 0);
}

}  // namespace
}  // namespace spikeserve
