// Tests of the experts with full tables: the mean return over Gymnasium's seeds 0 to 999 is within
// 1 % of the optimum, which is known from dynamic programming and search. On one core, solving the
// tables takes minutes and the beam search most of an hour.
#include <gtest/gtest.h>

#include <cmath>

#include "train/expert/expert.h"
#include "train/expert/expert_evaluation.h"

namespace spikeserve {
namespace {

struct Known {
  const char* environment;
  const char* name;
  double mean_return;
};

class FullExpertTest : public testing::TestWithParam<Known> {};

TEST_P(FullExpertTest, LandsWithinOnePercent) {
  const auto& [environment, name, mean_return] = GetParam();
  const ExpertOptions options = {.environment = environment, .name = name};
  const std::unique_ptr<Expert> expert = *MakeExpert(options);
  const ReturnSummary found = StatisticsOf(*EvaluateExpert(*expert, environment, 1000, 0));
  EXPECT_NEAR(found.mean, mean_return, 0.01 * std::abs(mean_return));
}

INSTANTIATE_TEST_SUITE_P(Experts, FullExpertTest,
                         testing::Values(Known{"CartPole-v1", "feedback", 500.0},
                                         Known{"MountainCar-v0", "value_iteration", -97.56},
                                         Known{"Pendulum-v1", "value_iteration", -135.30},
                                         Known{"Acrobot-v1", "beam", -58.68}),
                         [](const auto& test) {
                           std::string label = test.param.environment;
                           return label.substr(0, label.find('-'));
                         });

}  // namespace
}  // namespace spikeserve
