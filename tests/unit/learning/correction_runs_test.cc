#include "core/learning/correction_runs.h"

#include <gtest/gtest.h>

namespace spikeserve {
namespace {

constexpr double kBegin = 1e9;  // seconds since 1970

// A head that operators change, by a second each.
struct Taught {
  CorrectionRuns runs;
  Eigen::VectorXf head = Eigen::VectorXf::Zero(3);
  Corrections measured;
  double now = kBegin;

  void Correct(const char* operator_id, float change, int times) {
    for (int i = 0; i < times; ++i) {
      const Corrections before = measured;
      ++measured.steps;
      measured.Measure(1.0, 2.0, 3.0);
      runs.Add(operator_id, now, head, before);
      head.array() += change;
      now += 1.0;
    }
  }
};

TEST(CorrectionRunsTest, TheLastOperatorIsTakenOutBitForBit) {
  Taught taught;
  taught.Correct("ann", 0.1f, 5);
  const Taught before = taught;
  taught.Correct("bob", 0.3f, 40);  // in three runs
  EXPECT_EQ(taught.runs.Undo("bob", kBegin, &taught.head, &taught.measured), 40);
  EXPECT_EQ(taught.head, before.head);
  EXPECT_EQ(taught.measured.error, before.measured.error);
  EXPECT_EQ(taught.measured.steps, 45);  // happened
  EXPECT_EQ(taught.runs.Undo("bob", kBegin, &taught.head, &taught.measured), 0);
  EXPECT_EQ(taught.runs.Undo("ann", kBegin, &taught.head, &taught.measured), 5);
  EXPECT_EQ(taught.head, Eigen::VectorXf::Zero(3));
}

TEST(CorrectionRunsTest, WhatOthersHaveTaughtStays) {
  Taught taught;
  taught.Correct("ann", 1.0f, 2);
  taught.Correct("bob", 10.0f, 2);
  taught.Correct("ann", 2.0f, 1);
  taught.Correct("bob", 20.0f, 1);
  EXPECT_EQ(taught.runs.Undo("eve", kBegin, &taught.head, &taught.measured), 0);
  EXPECT_EQ(taught.head[0], 44.0f);
  EXPECT_EQ(taught.runs.Undo("ann", kBegin + 4.0, &taught.head, &taught.measured), 1);
  EXPECT_EQ(taught.head[0], 42.0f);
  EXPECT_EQ(taught.runs.Undo("bob", kBegin, &taught.head, &taught.measured), 3);
  EXPECT_EQ(taught.head[0], 2.0f);
  EXPECT_EQ(taught.runs.Undo("ann", kBegin, &taught.head, &taught.measured), 2);
  EXPECT_EQ(taught.head[0], 0.0f);
}

TEST(CorrectionRunsTest, WhatIsForgottenIsNotUndone) {
  Taught taught;
  taught.Correct("ann", 1.0f, 1);
  for (size_t i = 0; i < CorrectionRuns::kMost; ++i) {
    taught.Correct(i % 2 == 0 ? "bob" : "eve", 10.0f, 1);
  }
  EXPECT_EQ(taught.runs.runs.size(), CorrectionRuns::kMost);
  const Eigen::VectorXf head = taught.head;
  EXPECT_EQ(taught.runs.Undo("bob", kBegin, &taught.head, &taught.measured), std::nullopt);
  EXPECT_EQ(taught.head, head);
  EXPECT_EQ(taught.runs.Undo("bob", kBegin + 1.0, &taught.head, &taught.measured), 4);
  taught.runs.Forget();
  EXPECT_EQ(taught.runs.Undo("eve", kBegin + 1.0, &taught.head, &taught.measured), std::nullopt);
  EXPECT_EQ(taught.runs.Undo("eve", taught.now, &taught.head, &taught.measured), 0);
}

}  // namespace
}  // namespace spikeserve
