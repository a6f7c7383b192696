// Tests of grids, interpolation and value iteration on problems with known solutions.
#include "train/expert/value_iteration.h"

#include <gtest/gtest.h>

#include <cmath>

#include "core/environment/classic_tasks.h"

namespace spikeserve {
namespace {

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
