#include "core/learning/eligibility_trace.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace spikeserve {
namespace {

using testing::ElementsAre;

TEST(EligibilityTraceTest, DecaysAndAddsTheOuterProduct) {
  EligibilityTrace trace = EligibilityTrace::Zeros(2, 3);
  trace.Update(0.5f, {1.0f, -2.0f}, {0.0f, 1.0f, 0.5f});
  EXPECT_THAT(trace.values, ElementsAre(0.0f, 1.0f, 0.5f, 0.0f, -2.0f, -1.0f));
  trace.Update(0.5f, {1.0f, 0.0f}, {1.0f, 0.0f, 0.0f});
  EXPECT_THAT(trace.values, ElementsAre(1.0f, 0.5f, 0.25f, 0.0f, -1.0f, -0.5f));
}

TEST(EligibilityTraceTest, NormIsFrobeniusAndResetForgets) {
  EligibilityTrace trace = EligibilityTrace::Zeros(1, 2);
  trace.Update(0.9f, {1.0f}, {3.0f, 4.0f});
  EXPECT_DOUBLE_EQ(trace.Norm(), 5.0);
  trace.Reset();
  EXPECT_EQ(trace, EligibilityTrace::Zeros(1, 2));
}

}  // namespace
}  // namespace spikeserve
