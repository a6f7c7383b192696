#include "core/learning/contribution_budget.h"

#include <gtest/gtest.h>

#include <string>

namespace spikeserve {
namespace {

using Budget = ContributionBudget;

// Joins members "0", "1" and so on.
void Join(Budget& budget, size_t members) {
  for (size_t i = 0; i < members; ++i) budget.Join(std::to_string(i));
}

// Returns how many of 1000 contributions are accepted.
int Accepted(Budget& budget, const std::string& contributor, absl::Duration now) {
  int accepted = 0;
  for (int i = 0; i < 1000; ++i) accepted += budget.Take(contributor, now) ? 1 : 0;
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

TEST(ContributionBudgetTest, WithEnoughMembersNoneGivesAQuarterOfAWindow) {
  Budget budget;
  Join(budget, Budget::kProtectedMembers - 1);
  EXPECT_FALSE(budget.is_protected());
  budget.Join("last");
  budget.Join("last");
  EXPECT_TRUE(budget.is_protected());
  EXPECT_EQ(Accepted(budget, "0", {}), Budget::kPerWindow);
  budget.OnWindowEnd(/*bad=*/false);
  EXPECT_EQ(Accepted(budget, "0", {}), Budget::kPerWindow);
  budget.Leave("last");
  EXPECT_TRUE(budget.is_protected());
  budget.Leave("last");
  EXPECT_FALSE(budget.is_protected());
}

TEST(ContributionBudgetTest, AFullShareOfABadWindowSuspends) {
  Budget budget;
  Join(budget, Budget::kProtectedMembers);
  Accepted(budget, "0", {});
  EXPECT_TRUE(budget.Take("1", {}));
  budget.OnWindowEnd(/*bad=*/true);
  for (int window = 0; window < Budget::kSuspendedWindows; ++window) {
    EXPECT_TRUE(budget.IsSuspended("0")) << window;
    EXPECT_FALSE(budget.IsSuspended("1")) << window;
    EXPECT_TRUE(budget.Take("0", {})) << window;  // its returns count, so that windows end
    budget.OnWindowEnd(/*bad=*/false);
  }
  EXPECT_FALSE(budget.IsSuspended("0"));
}

}  // namespace
}  // namespace spikeserve
