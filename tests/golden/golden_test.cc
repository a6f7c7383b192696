// Tests that every shipped policy gives the answers whose hashes are in a file. Every
// processor, SIMD target, compiler and build type must give them. `make golden` rewrites the file.

#include <gtest/gtest.h>

#include <algorithm>
#include <string>

#include "tests/golden/golden_answers.h"
#include "tests/support/simd_targets.h"

namespace spikeserve::golden {
namespace {

class GoldenTest : public testing::TestWithParam<std::string> {
 protected:
  static std::string Expected(const std::string& kind) {
    static const Answers expected = ReadAnswers(SPIKESERVE_GOLDEN_ANSWERS);
    const auto found = expected.find(GetParam() + " " + kind);
    return found == expected.end() ? "an entry in the file of answers, received none"
                                   : found->second;
  }
  static std::string Path() {
    return std::string(SPIKESERVE_POLICIES) + "/" + GetParam() + "/policy.safetensors";
  }
};

TEST_P(GoldenTest, GreedyAnswersOfEverySimdTarget) {
  OnEverySimdTarget([] { EXPECT_EQ(HashAnswers(Path(), Kind::kGreedy), Expected("greedy")); });
}

// The rest is computed from the same readouts, without SIMD.
TEST_P(GoldenTest, SampledAnswers) {
  EXPECT_EQ(HashAnswers(Path(), Kind::kSampled), Expected("sampled"));
}

TEST_P(GoldenTest, LearnedAnswers) {
  EXPECT_EQ(HashAnswers(Path(), Kind::kLearning), Expected("learning"));
}

INSTANTIATE_TEST_SUITE_P(Policies, GoldenTest, testing::ValuesIn(ListVersions(SPIKESERVE_POLICIES)),
                         [](const auto& test) {
                           std::string name = test.param;
                           std::replace(name.begin(), name.end(), '/', '_');
                           std::replace(name.begin(), name.end(), '-', '_');
                           return name;
                         });

TEST(GoldenFileTest, HasAnEntryOfEachKindForEveryPolicyAndNoOther) {
  const Answers expected = ReadAnswers(SPIKESERVE_GOLDEN_ANSWERS);
  const auto versions = ListVersions(SPIKESERVE_POLICIES);
  EXPECT_FALSE(versions.empty());
  EXPECT_EQ(expected.size(), 3 * versions.size());
}

}  // namespace
}  // namespace spikeserve::golden
