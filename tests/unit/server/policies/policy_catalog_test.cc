#include "server/policies/policy_catalog.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <map>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "tests/support/session_fixture.h"
#include "tests/support/small_config.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

std::shared_ptr<const ServedPolicy> Version(int64_t version, int actions = 2) {
  auto served =
      std::make_shared<ServedPolicy>(*Serve(SmallConfig(), ActionSpace::Discrete(actions)));
  served->version = version;
  return served;
}

// One policy, "robot", with the versions 1, 2 and 3; version 3 has other actions.
PolicyCatalog Catalog(const PolicySettings& settings = {}) {
  PolicyCatalog catalog;
  catalog.policies()["robot"] = {
      .versions = {{1, Version(1)}, {2, Version(2)}, {3, Version(3, /*actions=*/3)}},
      .settings = settings};
  return catalog;
}

int64_t VersionOf(const PolicyCatalog& catalog, const std::string& key) {
  const auto route = catalog.Choose({.policy = "robot", .routing_key = key});
  EXPECT_TRUE(route.ok()) << route.status();
  return route.ok() ? route->served->version : -1;
}

TEST(PolicyCatalog, TheDefaultIsTheHighestVersionUnlessOneIsSet) {
  EXPECT_EQ(VersionOf(Catalog(), "a"), 3);
  EXPECT_EQ(VersionOf(Catalog({.default_version = 1}), "a"), 1);
}

TEST(PolicyCatalog, TrafficIsDividedByPercentAndAKeyKeepsItsVersion) {
  const PolicyCatalog catalog =
      Catalog({.shares = {{.version = 1, .percent = 70}, {.version = 2, .percent = 30}}});
  std::map<int64_t, int> sessions;
  for (int i = 0; i < 10'000; ++i) {
    const std::string key = absl::StrCat("robot-", i);
    const int64_t version = VersionOf(catalog, key);
    ++sessions[version];
    EXPECT_EQ(VersionOf(catalog, key), version) << key;
  }
  // The deviation of a share of 10,000 keys is below 50.
  EXPECT_NEAR(sessions[1], 7'000, 250);
  EXPECT_NEAR(sessions[2], 3'000, 250);
  EXPECT_EQ(sessions[3], 0);
}

TEST(PolicyCatalog, AShareThatGrowsKeepsTheKeysItHad) {
  const auto with_percent = [](int percent) {
    return Catalog(
        {.shares = {{.version = 2, .percent = percent}, {.version = 1, .percent = 100 - percent}}});
  };
  const PolicyCatalog before = with_percent(10), after = with_percent(40);
  for (int i = 0; i < 1'000; ++i) {
    const std::string key = absl::StrCat(i);
    if (VersionOf(before, key) == 2) {
      EXPECT_EQ(VersionOf(after, key), 2) << key;
    }
  }
}

TEST(PolicyCatalog, AKeyFallsIntoSharesOfTwoPoliciesIndependently) {
  PolicyCatalog catalog =
      Catalog({.shares = {{.version = 1, .percent = 50}, {.version = 2, .percent = 50}}});
  catalog.policies()["other"] = catalog.policies()["robot"];
  int equal = 0;
  for (int i = 0; i < 1'000; ++i) {
    const auto other = catalog.Choose({.policy = "other", .routing_key = absl::StrCat(i)});
    ASSERT_TRUE(other.ok());
    equal += other->served->version == VersionOf(catalog, absl::StrCat(i));
  }
  EXPECT_NEAR(equal, 500, 100);
}

TEST(PolicyCatalog, AVersionOrALabelOverridesTheDivision) {
  const PolicyCatalog catalog =
      Catalog({.labels = {{"stable", 2}}, .shares = {{.version = 1, .percent = 100}}});
  EXPECT_EQ((*catalog.Choose({.policy = "robot", .version = 3})).served->version, 3);
  EXPECT_EQ((*catalog.Choose({.policy = "robot", .label = "stable"})).served->version, 2);
}

TEST(PolicyCatalog, WhatDoesNotExistIsRefusedByName) {
  const PolicyCatalog catalog = Catalog({.labels = {{"stable", 2}}});
  const auto refused = [&](const VersionChoice& choice) { return catalog.Choose(choice).status(); };
  EXPECT_EQ(refused({.policy = "rabot"}),
            absl::NotFoundError("policy: expected one of [robot], received \"rabot\"; did "
                                "you mean robot?"));
  EXPECT_EQ(
      refused({.policy = "robot", .version = 4}),
      absl::NotFoundError("version: expected 0 or one of [1, 2, 3] of policy robot, received 4"));
  EXPECT_EQ(refused({.policy = "robot", .label = "canary"}),
            absl::NotFoundError(
                "version_label: expected one of [stable] of policy robot, received \"canary\""));
  EXPECT_EQ(refused({.policy = "robot", .version = 1, .label = "stable"}).code(),
            absl::StatusCode::kInvalidArgument);
}

TEST(PolicyCatalog, AShadowAccompaniesOtherVersionsOfEqualSpaces) {
  const PolicyCatalog catalog = Catalog({.shadow_version = 2});
  const auto shadow_of = [&](int64_t version) {
    return (*catalog.Choose({.policy = "robot", .version = version})).shadow;
  };
  ASSERT_NE(shadow_of(1), nullptr);
  EXPECT_EQ(shadow_of(1)->version, 2);
  EXPECT_EQ(shadow_of(2), nullptr) << "a version does not shadow itself";
  EXPECT_EQ(shadow_of(3), nullptr) << "version 3 has another action space";
}

}  // namespace
}  // namespace spikeserve
