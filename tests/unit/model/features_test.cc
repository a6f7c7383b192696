#include "core/model/features.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <memory>
#include <string>
#include <vector>

#include "core/model/policy_file.h"
#include "core/model/wiring_fit.h"
#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

using testing::HasSubstr;

constexpr char kText[] =
    R"({"observation": ["x", {"name": "v", "unit": "m/s", "low": -1, "high": 2.5},
  {"name": "angle", "unit": "rad", "frame": "upright"}, "rate"],
  "action": ["left", "right"], "rate_hz": 50, "rate_tolerance": 0.2})";

std::string Refusal(const std::vector<std::string>& names, const std::vector<std::string>& units,
                    bool in_any_order = false) {
  const Features features = *ParseFeatures(kText);
  return std::string(CheckNames(features.observation,
                                {.field = "observation", .names = names, .units = units},
                                in_any_order)
                         .message());
}

TEST(FeaturesTest, AFileKeepsThemAndTheModelOfTheObservations) {
  Policy policy = SmallPolicy();
  const std::string plain = *FormatPolicyFile(policy);
  EXPECT_THAT(plain, testing::Not(HasSubstr("features")));
  EXPECT_TRUE(ParsePolicyFile(plain)->features.empty());

  policy.features = *ParseFeatures(kText);
  WiringFit fit(4, 2);
  std::vector<float> observations, actions;
  for (int i = 0; i < 101 * 4; ++i) observations.push_back(static_cast<float>(i * i % 17));
  for (int i = 0; i < 100; ++i) actions.insert(actions.end(), {i % 3 ? 1.0f : 0.0f, 0.0f});
  fit.Add(observations, actions);
  policy.wiring = std::make_shared<const WiringModel>(*fit.Finish());
  const std::string named = *FormatPolicyFile(policy);
  const Policy read = *ParsePolicyFile(named);
  EXPECT_EQ(read.features, policy.features);
  EXPECT_EQ(*read.wiring, *policy.wiring);
  EXPECT_EQ(*FormatPolicyFile(read), named);
}

TEST(FeaturesTest, RefusesWhatDoesNotFitThePolicy) {
  const auto refused = [](const std::string& text) {
    auto features = ParseFeatures(text);
    if (!features.ok()) return std::string(features.status().message());
    return std::string(features->Validate(2, 2).message());
  };
  EXPECT_EQ(refused(R"({"observation": ["x"]})"),
            "features.observation: expected none or 2 elements, received 1");
  EXPECT_THAT(refused(R"({"observation": ["x", "x"]})"), HasSubstr("another name than before"));
  EXPECT_THAT(refused(R"({"observation": ["x", ""]})"), HasSubstr("[1].name: expected a name"));
  EXPECT_THAT(refused(R"({"observation": ["x", {"name": "y", "low": 1, "high": 0}]})"),
              HasSubstr("features.observation[1].high: expected at least 1, received 0"));
  EXPECT_THAT(refused(R"({"rate_hz": 0})"), HasSubstr("rate_hz: expected a positive"));
  EXPECT_THAT(refused(R"({"observations": []})"), HasSubstr("observations"));
}

TEST(FeaturesTest, NamesTheFirstDifferenceAndThePermutation) {
  EXPECT_EQ(Refusal({"x", "v", "angle", "rate"}, {}), "");
  EXPECT_EQ(Refusal({}, {}), "");
  EXPECT_EQ(
      Refusal({"x", "angle", "v", "rate"}, {}),
      "observation_names[1]: expected \"v\", received \"angle\"; the policy's order is [0, 2, "
      "1, 3] of the received elements");
  EXPECT_EQ(Refusal({"x", "angle", "v", "rate"}, {}, /*in_any_order=*/true), "");
  for (const bool in_any_order : {false, true}) {
    EXPECT_EQ(Refusal({"x", "v", "angle", "speed"}, {}, in_any_order),
              "observation_names[3]: expected \"rate\", received \"speed\"; the policy has x, v, "
              "angle, rate");
    EXPECT_THAT(Refusal({"x", "x", "angle", "rate"}, {}, in_any_order),
                HasSubstr("expected \"v\""));
    EXPECT_THAT(Refusal({"x", "v"}, {}, in_any_order), HasSubstr("expected 4 names"));
  }
}

TEST(FeaturesTest, NamesUnitsThatCanBeConverted) {
  EXPECT_EQ(Refusal({"x", "v", "angle", "rate"}, {"", "m/s", "rad", ""}), "");
  EXPECT_EQ(Refusal({"angle", "v", "x", "rate"}, {"deg", "", "", ""}, /*in_any_order=*/true),
            "observation_units[0] (angle): expected \"rad\", received \"deg\"; multiply by "
            "0.0174533 to convert");
  EXPECT_EQ(Refusal({"x", "v", "angle", "rate"}, {"", "N", "", ""}),
            "observation_units[1] (v): expected \"m/s\", received \"N\"");
  EXPECT_THAT(Refusal({"x", "v", "angle", "rate"}, {"m"}), HasSubstr("expected one per name"));
  EXPECT_DOUBLE_EQ(*UnitFactor("km/h", "m/s"), 1000.0 / 3600.0);
  EXPECT_DOUBLE_EQ(*UnitFactor("kN.m", "N.m"), 1000.0);
  EXPECT_DOUBLE_EQ(*UnitFactor("cm/s2", "m/s2"), 0.01);
  EXPECT_FALSE(UnitFactor("m", "rad").has_value());
  EXPECT_FALSE(UnitFactor("furlong", "m").has_value());
}

}  // namespace
}  // namespace spikeserve
