#include "train/expert/beam_search.h"

#include <gtest/gtest.h>

#include "core/environment/classic_tasks.h"

namespace spikeserve {
namespace {

constexpr double kPi = 3.14159265358979323846;

class BeamSearchTest : public testing::Test {
 protected:
  BeamSearchTest() {
    for (int torque = 0; torque < 3; ++torque) {
      problem_.choices.push_back(Choice::Of({.discrete = torque, .continuous = {}}));
    }
  }

  Problem problem_ = {.model = MakeAcrobot(), .choices = {}};
  // A table without information: the value of every state is 0.
  const ValueTable<4> flat_ = {
      Grid<4>({{{-kPi, kPi, 2}, {-kPi, kPi, 2}, {-30.0, 30.0, 2}, {-30.0, 30.0, 2}}}),
      std::vector<float>(16)};
};

TEST_F(BeamSearchTest, ThePlanEndsAtTheGoalAndNotBefore) {
  Grid<4>::State state = {1.9, 0.0, 0.5, 0.0};
  const std::vector<int> plan = BeamSearch(problem_, flat_, state, 500, 60);
  ASSERT_FALSE(plan.empty());
  for (size_t i = 0; i < plan.size(); ++i) {
    EXPECT_FALSE(problem_.model->IsTerminal(state));
    problem_.model->Advance(problem_.choices[plan[i]].action, absl::MakeSpan(state));
  }
  EXPECT_TRUE(problem_.model->IsTerminal(state));
}

TEST_F(BeamSearchTest, NoPlanWithinTheLimitIsNone) {
  EXPECT_TRUE(BeamSearch(problem_, flat_, {0.0, 0.0, 0.0, 0.0}, 50, 4).empty());
}

}  // namespace
}  // namespace spikeserve
