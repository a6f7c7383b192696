#include "server/policies/policy_settings.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <fstream>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "tests/support/temporary_directory.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
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

TEST(PolicySettings, APolicyWithoutSettingsIsNotKept) {
  const auto settings = ParseSettings(R"({"policies": {"cartpole": {}}})");
  ASSERT_TRUE(settings.ok()) << settings.status();
  EXPECT_THAT(settings->policies, IsEmpty());
}

TEST(PolicySettings, AFileThatDoesNotExistHoldsNoSettings) {
  const TemporaryDirectory directory;
  const auto read = ReadSettings((directory.path() / "none.json").string());
  ASSERT_TRUE(read.ok()) << read.status();
  EXPECT_THAT(read->policies, IsEmpty());
}

TEST(PolicySettings, AFileThatCannotBeReadIsRefusedByPath) {
  const TemporaryDirectory directory;
  EXPECT_THAT(std::string(ReadSettings(directory.path().string()).status().message()),
              StartsWith(directory.path().string()));
  const std::string path = (directory.path() / "settings.json").string();
  std::ofstream(path) << "{";
  EXPECT_THAT(std::string(ReadSettings(path).status().message()), StartsWith(path + ": settings:"));
}

TEST(PolicySettings, EveryWrongValueIsRefusedByItsField) {
  const auto refused = [](const std::string& policy, const std::string& message) {
    const auto parsed = ParseSettings("{\"policies\": {\"p\": " + policy + "}}");
    EXPECT_EQ(parsed.status().code(), absl::StatusCode::kInvalidArgument) << policy;
    EXPECT_THAT(std::string(parsed.status().message()), HasSubstr(message));
  };
  refused("[]", "policies.p: expected an object, received an array of 0");
  refused(R"({"defualt_version": 1})",
          "policies.p: expected no other keys, received \"defualt_version\"");
  refused(R"({"default_version": 0})",
          "policies.p.default_version: expected an integer of at least 1");
  refused(R"({"default_version": "1"})",
          "policies.p.default_version: expected an integer of at least 1");
  refused(R"({"default_version": 1, "default_follows_highest": true})",
          "policies.p.default_version: expected none beside default_follows_highest, received 1");
  refused(R"({"shadow_version": 1.5})",
          "policies.p.shadow_version: expected an integer of at least 1");
  refused(R"({"learning_paused": 1})", "policies.p.learning_paused: expected true or false");
  refused(R"({"labels": {"a b": 1}})", "policies.p.labels: expected letters, digits");
  refused(R"({"labels": {"a": -1}})", "policies.p.labels.a: expected an integer of at least 1");
  refused(R"({"shares": {}})", "policies.p.shares: expected an array, received an object");
  refused(R"({"shares": [{"version": 1, "percent": 101}]})",
          "policies.p.shares[0].percent: expected an integer from 0 to 100, received 101");
  refused(R"({"shares": [{"version": 1, "percent": 60}]})",
          "policies.p.shares: expected percents that add up to 100, received 60");
  refused(R"({"shares": [{"version": 1, "percent": 50}, {"version": 1, "percent": 50}]})",
          "policies.p.shares: expected each version once, received 1 twice");
  EXPECT_THAT(std::string(ParseSettings(R"({"policy": {}})").status().message()),
              HasSubstr("expected no other keys, received \"policy\""));
  EXPECT_THAT(std::string(ParseSettings(R"({"unloaded": {"p": [0]}})").status().message()),
              HasSubstr("unloaded.p: expected an integer of at least 1"));
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
