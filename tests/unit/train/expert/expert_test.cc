// Tests of all experts, with coarse tables.
#include "train/expert/expert.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <fstream>

#include "core/environment/classic_tasks.h"
#include "train/expert/beam_search.h"
#include "train/expert/expert_evaluation.h"
#include "train/expert/value_iteration.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

double MeanReturn(const ExpertOptions& options, int episodes) {
  const std::unique_ptr<Expert> expert = *MakeExpert(options);
  return StatisticsOf(*EvaluateExpert(*expert, options.environment, episodes, 0)).mean;
}

TEST(ExpertTest, CartPoleIsBalanced) { EXPECT_EQ(MeanReturn({}, 20), 500.0); }

TEST(ExpertTest, MountainCarClimbsOnACoarseTable) {
  EXPECT_GT(MeanReturn({.environment = "MountainCar-v0", .coarsening = 8}, 50), -105.0);
}

TEST(ExpertTest, PendulumSwingsUpOnACoarseTable) {
  EXPECT_GT(MeanReturn({.environment = "Pendulum-v1", .coarsening = 8}, 50), -200.0);
}

TEST(ExpertTest, RobustPendulumSwingsUpOnACoarseTable) {
  EXPECT_GT(MeanReturn({.environment = "Pendulum-v1", .name = "robust", .coarsening = 8}, 50),
            -220.0);
}

TEST(ExpertTest, AcrobotSwingsUpOnACoarseTableAndABeamIsBest) {
  ExpertOptions options = {.environment = "Acrobot-v1", .beam_width = 200, .coarsening = 4};
  const double beam = MeanReturn(options, 3);
  options.name = "greedy";
  const double greedy = MeanReturn(options, 3);
  EXPECT_GT(beam, -80.0);
  EXPECT_GT(beam, greedy);
}

TEST(ExpertTest, CautiousPendulumSwingsUpOnACoarseTable) {
  EXPECT_GT(MeanReturn({.environment = "Pendulum-v1", .name = "cautious", .coarsening = 8}, 50),
            -220.0);
}

// Every episode lasts the number of steps that is drawn from its seed.
TEST(ExpertTest, ReturnConditionedOnesLastAsLongAsTheyAreAsked) {
  const std::unique_ptr<Expert> cart_pole = *MakeExpert({.name = "return_conditioned"});
  const std::vector<double> returns = *EvaluateExpert(*cart_pole, "CartPole-v1", 50, 0);
  const auto [least, most] = std::minmax_element(returns.begin(), returns.end());
  EXPECT_LT(*least, 100.0);
  EXPECT_GT(*most, 400.0);
  EXPECT_NEAR(StatisticsOf(returns).mean, 255.0, 70.0);

  const std::unique_ptr<Expert> car =
      *MakeExpert({.environment = "MountainCar-v0", .name = "return_conditioned", .coarsening = 8});
  const std::vector<double> climbs = *EvaluateExpert(*car, "MountainCar-v0", 50, 0);
  EXPECT_NEAR(StatisticsOf(climbs).mean, -150.0, 15.0);
}

TEST(ExpertTest, WhatNobodySeesDoesNotHinderAnExpert) {
  EXPECT_EQ(MeanReturn({.environment = "PositionOnlyCartPole-v1"}, 5), 500.0);
}

TEST(ExpertTest, StakesAreHighWhereAChoiceMatters) {
  const std::unique_ptr<Expert> pendulum =
      *MakeExpert({.environment = "Pendulum-v1", .coarsening = 8});
  const double upright = pendulum->StateImportance(std::vector<double>{0.2, 0.0});
  const double fast = pendulum->StateImportance(std::vector<double>{3.1, 8.0});
  EXPECT_GT(upright, 0.0);
  EXPECT_GT(upright, fast);
  EXPECT_EQ((*MakeExpert({}))->StateImportance(std::vector<double>(4)), 1.0);
}

TEST(ExpertTest, TablesAreSolvedOnceAndReadAgain) {
  const std::string directory =
      (std::filesystem::path(testing::TempDir()) / "expert_tables").string();
  std::filesystem::remove_all(directory);
  ExpertOptions options = {
      .environment = "MountainCar-v0", .tables_directory = directory, .coarsening = 8};
  const double solved = MeanReturn(options, 20);
  const std::string path = directory + "/mountain_car-coarse.safetensors";
  ASSERT_TRUE(std::filesystem::exists(path));
  const auto written = std::filesystem::last_write_time(path);
  EXPECT_EQ(MeanReturn(options, 20), solved);
  EXPECT_EQ(std::filesystem::last_write_time(path), written);

  std::ofstream(path) << "not a table";
  EXPECT_THAT(std::string(MakeExpert(options).status().message()), HasSubstr(path));
  options.coarsening = 4;  // the same file, another shape
  std::filesystem::remove(path);
  ASSERT_TRUE(MakeExpert(options).ok());
  options.coarsening = 8;
  EXPECT_EQ(MakeExpert(options).status().code(), absl::StatusCode::kInvalidArgument);
}

TEST(ExpertTest, UnknownOnesAreNamed) {
  EXPECT_EQ(
      MakeExpert({.environment = "Pendulum-v1", .name = "beam"}).status().message(),
      "expert: expected value_iteration, robust or cautious for Pendulum-v1, received 'beam'");
  EXPECT_THAT(std::string(MakeExpert({.environment = "Pong"}).status().message()),
              HasSubstr("none for 'Pong'"));
  EXPECT_EQ(MakeExpert({.beam_width = 0}).status().message(),
            "beam_width: expected at least 1, received 0");
}

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

TEST(GridTest, InterpolationIsExactForMultilinearFunctions) {
  const Grid<3> grid({{{-1.0, 1.0, 5}, {0.0, 3.0, 4}, {2.0, 4.0, 2}}});
  const auto f = [](const Grid<3>::State& s) { return 1 + s[0] - 2 * s[1] * s[2] + s[0] * s[1]; };
  std::vector<float> values;
  for (size_t i = 0; i < grid.size(); ++i) {
    values.push_back(static_cast<float>(f(grid.StateAt(i))));
  }
  ASSERT_EQ(values.size(), 40u);
  for (const Grid<3>::State& state :
       {Grid<3>::State{0.3, 1.7, 2.2}, {-1.0, 0.0, 2.0}, {1.0, 3.0, 4.0}, {0.5, 2.0, 3.9}}) {
    EXPECT_NEAR(grid.Interpolate(values, state), f(state), 1e-5);
  }
  EXPECT_NEAR(grid.Interpolate(values, {9.0, -9.0, 3.0}), f({1.0, 0.0, 3.0}), 1e-5);
}

TEST(GridTest, PeriodicAxesHaveNoSeam) {
  const Grid<1> grid(Axes<1>{Axis{0.0, 4.0, 4, true}});
  const std::vector<float> values = {0.0f, 1.0f, 2.0f, 3.0f};
  EXPECT_NEAR(grid.Interpolate(values, {3.5}), 1.5, 1e-6);
  EXPECT_NEAR(grid.Interpolate(values, {-0.5}), 1.5, 1e-6);
  EXPECT_NEAR(grid.Interpolate(values, {9.5}), 1.5, 1e-6);
  EXPECT_NEAR(grid.StateAt(3)[0], 3.0, 1e-6);
}

TEST(GridTest, CoarserAxesSpanTheSameBox) {
  const Axis ends = Axis{-1.0, 1.0, 9}.Coarser(4), ring = Axis{-1.0, 1.0, 8, true}.Coarser(4);
  EXPECT_EQ(ends.points, 3);
  EXPECT_EQ(ends.step(), 1.0);
  EXPECT_EQ(ring.points, 2);
  EXPECT_EQ(ring.step(), 1.0);
}

Problem CarProblem() {
  Problem problem = {.model = MakeMountainCar(), .choices = {}};
  for (int push = 0; push < 3; ++push) {
    problem.choices.push_back(Choice::Of({.discrete = push, .continuous = {}}));
  }
  return problem;
}

TEST(ValueIterationTest, TheSolutionSatisfiesBellmansEquation) {
  const Problem problem = CarProblem();
  const ValueTable<2> table = SolveValueTable<2>(problem, {{{-1.2, 0.6, 91}, {-0.07, 0.07, 71}}},
                                                 {.tolerance = 1e-3, .coarsest = 2});
  for (size_t point = 0; point < table.grid.size(); point += 7) {
    const Grid<2>::State state = table.grid.StateAt(point);
    if (problem.model->IsTerminal(state)) {
      EXPECT_EQ(table.values[point], 0.0f);
    } else {
      EXPECT_NEAR(table.values[point], table.Best(problem, state).value, 2e-3);
    }
  }
  // At full speed just before the goal, one step is left.
  EXPECT_EQ(table.Best(problem, {0.45, 0.07}).value, -1.0);
}

TEST(ValueIterationTest, ADisturbanceIsAveragedOver) {
  Problem problem = CarProblem();
  problem.choices = {{{.discrete = 2, .continuous = {}},
                      {{.discrete = 0, .continuous = {}}, {.discrete = 2, .continuous = {}}}}};
  ValueTable<2> table = {Grid<2>({{{-1.2, 0.6, 2}, {-0.07, 0.07, 2}}}), {0.0f, 1.0f, 0.0f, 1.0f}};
  // The table is linear in velocity, so the mean value of two opposite pushes equals the value of
  // coasting.
  const Choice coast = Choice::Of({.discrete = 1, .continuous = {}});
  EXPECT_NEAR(table.Backup(problem, {-0.5, 0.01}, problem.choices[0]),
              table.Backup(problem, {-0.5, 0.01}, coast), 1e-6);
}

TEST(ValueTableTest, LookaheadCountsStepsUntilTheGoal) {
  const Problem problem = CarProblem();
  const ValueTable<2> table = {Grid<2>({{{-1.2, 0.6, 2}, {-0.07, 0.07, 2}}}),
                               std::vector<float>(4)};
  EXPECT_EQ(table.Best(problem, {-0.5, 0.0}, 3).value, -3.0);
  EXPECT_EQ(table.Best(problem, {0.42, 0.06}, 3).value, -2.0);
}

}  // namespace
}  // namespace spikeserve
