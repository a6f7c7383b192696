// Tests that every shipped policy, and small random ones in float32, give the answers whose hashes
// are in a file. Every processor, SIMD target, compiler and build type must give them. `make
// golden` rewrites the file.

#include <gtest/gtest.h>

#include <algorithm>
#include <ostream>
#include <string>
#include <vector>

#include "tests/golden/golden_answers.h"
#include "tests/support/simd_targets.h"

namespace spikeserve::golden {

void PrintTo(const Subject& subject, std::ostream* out) { *out << subject.name; }

namespace {

class GoldenTest : public testing::TestWithParam<Subject> {
 protected:
  static std::string Expected(const std::string& kind) {
    static const Answers expected = ReadAnswers(SPIKESERVE_GOLDEN_ANSWERS);
    const auto found = expected.find(GetParam().name + " " + kind);
    return found == expected.end() ? "an entry in the file of answers, received none"
                                   : found->second;
  }
  static std::string Hash(Kind kind) { return HashAnswers(GetParam().policy, kind); }
};

TEST_P(GoldenTest, GreedyAnswersOfEverySimdTarget) {
  OnEverySimdTarget([] { EXPECT_EQ(Hash(Kind::kGreedy), Expected("greedy")); });
}

// The rest is computed from the same readouts, without SIMD.
TEST_P(GoldenTest, SampledAnswers) { EXPECT_EQ(Hash(Kind::kSampled), Expected("sampled")); }

TEST_P(GoldenTest, LearnedAnswers) { EXPECT_EQ(Hash(Kind::kLearning), Expected("learning")); }

INSTANTIATE_TEST_SUITE_P(Policies, GoldenTest, testing::ValuesIn(AllSubjects(SPIKESERVE_POLICIES)),
                         [](const auto& test) {
                           std::string name = test.param.name;
                           std::replace(name.begin(), name.end(), '/', '_');
                           std::replace(name.begin(), name.end(), '-', '_');
                           return name;
                         });

TEST(GoldenFileTest, HasAnEntryOfEachKindForEveryPolicyAndNoOther) {
  const Answers expected = ReadAnswers(SPIKESERVE_GOLDEN_ANSWERS);
  const std::vector<Subject> subjects = AllSubjects(SPIKESERVE_POLICIES);
  EXPECT_GT(subjects.size(), RandomSubjects().size());
  EXPECT_EQ(expected.size(), 3 * subjects.size());
}

}  // namespace
}  // namespace spikeserve::golden
