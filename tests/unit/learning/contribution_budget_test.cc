#include "core/learning/contribution_budget.h"

#include <gtest/gtest.h>

#include <string>

namespace spikeserve {
namespace {

using Budget = ContributionBudget;

// Returns how many of 1000 contributions are accepted.
int Accepted(Budget& budget, const std::string& contributor, absl::Duration now,
             bool is_protected = false) {
  int accepted = 0;
  for (int i = 0; i < 1000; ++i) accepted += budget.Take(contributor, now, is_protected) ? 1 : 0;
  return accepted;
}

TEST(ContributionBudgetTest, AMinuteIsBoundedForOneAndForAll) {
  Budget budget;
  EXPECT_EQ(Accepted(budget, "0", absl::Seconds(1)), Budget::kPerMinute);
  int together = Budget::kPerMinute;
  for (int i = 1; i < 20; ++i) together += Accepted(budget, std::to_string(i), absl::Seconds(1));
  EXPECT_EQ(together, Budget::kTotalPerMinute);
  EXPECT_EQ(Accepted(budget, "0", absl::Seconds(59)), 0);
  EXPECT_EQ(Accepted(budget, "0", absl::Seconds(100)), Budget::kPerMinute);
}

TEST(ContributionBudgetTest, OfAProtectedHeadNoneGivesAQuarterOfAWindow) {
  Budget budget;
  for (int window = 0; window < 3; ++window) {
    EXPECT_EQ(Accepted(budget, "0", {}, /*is_protected=*/true), Budget::kPerWindow);
    budget.OnWindowEnd(/*bad=*/false, /*is_protected=*/true);
  }
}

TEST(ContributionBudgetTest, AFullShareOfABadWindowSuspends) {
  Budget budget;
  constexpr bool kIsProtected = true;
  Accepted(budget, "0", {}, kIsProtected);
  EXPECT_TRUE(budget.Take("1", {}, kIsProtected));
  budget.OnWindowEnd(/*bad=*/true, kIsProtected);
  for (int window = 0; window < Budget::kSuspendedWindows; ++window) {
    EXPECT_TRUE(budget.IsSuspended("0")) << window;
    EXPECT_FALSE(budget.IsSuspended("1")) << window;
    EXPECT_TRUE(budget.Take("0", {}, kIsProtected))
        << window;  // its returns count, so that windows end
    budget.OnWindowEnd(/*bad=*/false, kIsProtected);
  }
  EXPECT_FALSE(budget.IsSuspended("0"));
}

}  // namespace
}  // namespace spikeserve
