// Tests that do not need Gymnasium. The tests in tests/python compare the dynamics with
// Gymnasium's, step by step.
#include "core/environment/environment.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <memory>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "core/environment/acrobot.h"
#include "core/environment/cart_pole.h"
#include "core/environment/mountain_car.h"
#include "core/environment/pendulum.h"

namespace spikeserve {
namespace {

using ::testing::AllOf;
using ::testing::Each;
using ::testing::ElementsAre;
using ::testing::Ge;
using ::testing::Le;

Action Discrete(int index) { return {.discrete = index, .continuous = {}}; }
Action Continuous(float value) { return {.discrete = 0, .continuous = {value}}; }

std::unique_ptr<Environment> Make(absl::string_view id) {
  auto environment = MakeEnvironment(id);
  EXPECT_TRUE(environment.ok()) << environment.status();
  return *std::move(environment);
}

TEST(MakeEnvironmentTest, UnknownIdIsNotFoundAndNamesTheIdsThereAre) {
  const auto environment = MakeEnvironment("LunarLander-v3");
  ASSERT_EQ(environment.status().code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(environment.status().message(),
            "environment: expected one of CartPole-v1, MountainCar-v0, Acrobot-v1, Pendulum-v1, "
            "PositionOnlyCartPole-v1, PositionOnlyPendulum-v1, received \"LunarLander-v3\"");
}

struct Facts {
  std::string id;
  int observation_size;
  ActionSpace action_space;
  int max_episode_steps;
};

class EveryEnvironmentTest : public ::testing::TestWithParam<Facts> {};

INSTANTIATE_TEST_SUITE_P(
    , EveryEnvironmentTest,
    ::testing::Values(Facts{"CartPole-v1", 4, ActionSpace::Discrete(2), 500},
                      Facts{"MountainCar-v0", 2, ActionSpace::Discrete(3), 200},
                      Facts{"Acrobot-v1", 6, ActionSpace::Discrete(3), 500},
                      Facts{"Pendulum-v1", 3, ActionSpace::Box({-2.0F}, {2.0F}), 200},
                      Facts{"PositionOnlyCartPole-v1", 2, ActionSpace::Discrete(2), 500},
                      Facts{"PositionOnlyPendulum-v1", 2, ActionSpace::Box({-2.0F}, {2.0F}), 200}),
    [](const auto& test) { return test.param.id.substr(0, test.param.id.find('-')); });

TEST_P(EveryEnvironmentTest, DescribesItself) {
  const auto environment = Make(GetParam().id);
  EXPECT_EQ(environment->id(), GetParam().id);
  EXPECT_EQ(environment->observation_size(), GetParam().observation_size);
  EXPECT_EQ(environment->action_space(), GetParam().action_space);
  EXPECT_EQ(environment->max_episode_steps(), GetParam().max_episode_steps);
  EXPECT_EQ(environment->Reset(0).size(), GetParam().observation_size);
}

TEST_P(EveryEnvironmentTest, SeedDecidesTheStart) {
  const auto environment = Make(GetParam().id);
  const std::vector<float> first = environment->Reset(1);
  EXPECT_NE(environment->Reset(2), first);
  EXPECT_EQ(environment->Reset(1), first);
}

TEST_P(EveryEnvironmentTest, ResetToItsOwnStateReplaysTheStep) {
  const auto environment = Make(GetParam().id);
  const Action action = GetParam().action_space.is_discrete() ? Discrete(0) : Continuous(1.5F);
  environment->Reset(5);
  const std::vector<double> start(environment->state().begin(), environment->state().end());
  const StepResult first = environment->Step(action);
  environment->ResetTo(start);
  const StepResult again = environment->Step(action);
  EXPECT_EQ(again.observation, first.observation);
  EXPECT_EQ(again.reward, first.reward);
}

// Repeats one action until the episode ends. Returns the last result and stores the number of steps
// in `steps`.
StepResult RunToTheEnd(Environment& environment, const Action& action, int& steps) {
  StepResult result;
  for (steps = 0; !result.done(); ++steps) result = environment.Step(action);
  return result;
}

TEST(TruncationTest, EpisodesEndAtTheTimeLimit) {
  int steps = 0;
  for (const auto& [id, action] : {std::pair<std::string, Action>{"MountainCar-v0", Discrete(1)},
                                   {"Acrobot-v1", Discrete(1)},
                                   {"Pendulum-v1", Continuous(0.0F)}}) {
    const auto environment = Make(id);
    for (int episode = 0; episode < 2; ++episode) {  // the second shows that Reset clears the count
      environment->Reset(episode);
      const StepResult last = RunToTheEnd(*environment, action, steps);
      EXPECT_TRUE(last.truncated) << id;
      EXPECT_FALSE(last.terminated) << id;
      EXPECT_EQ(steps, environment->max_episode_steps()) << id;
    }
  }
}

TEST(TruncationTest, LastStepMayTerminateAndTruncate) {
  // Without gravity and force the cart moves at a constant velocity and passes 2.4 m at step 500.
  CartPole coasting({.gravity = 0.0, .force = 0.0});
  coasting.ResetTo({0.0, 0.2402, 0.0, 0.0});
  int steps = 0;
  const StepResult last = RunToTheEnd(coasting, Discrete(0), steps);
  EXPECT_EQ(steps, 500);
  EXPECT_TRUE(last.truncated);
  EXPECT_TRUE(last.terminated);
}

TEST(CartPoleTest, TerminatesBeyondEitherBoundWithFullReward) {
  CartPole cart_pole;
  for (const std::vector<double>& state : {std::vector<double>{2.39, 1.0, 0.0, 0.0},
                                           {-2.39, -1.0, 0.0, 0.0},
                                           {0.0, 0.0, 0.209, 1.0},
                                           {0.0, 0.0, -0.209, -1.0}}) {
    cart_pole.ResetTo(state);
    const StepResult result = cart_pole.Step(Discrete(0));
    EXPECT_TRUE(result.terminated);
    EXPECT_FALSE(result.truncated);
    EXPECT_EQ(result.reward, 1.0);
  }
}

TEST(CartPoleTest, RunsOnWithinTheBounds) {
  CartPole cart_pole;
  cart_pole.ResetTo({2.39, 0.0, 0.209, 0.0});
  EXPECT_FALSE(cart_pole.Step(Discrete(1)).terminated);
}

TEST(MountainCarTest, StopsAtTheLeftWallAndKeepsToTheSpeedLimit) {
  MountainCar car;
  car.ResetTo({-1.19, -0.07});
  EXPECT_THAT(car.Step(Discrete(0)).observation, ElementsAre(-1.2F, 0.0F));
  car.ResetTo({0.1, -0.07});
  EXPECT_EQ(car.Step(Discrete(0)).observation[1], -0.07F);
}

TEST(MountainCarTest, TerminatesAtTheGoalOnlyWhenNotRollingBack) {
  MountainCar car;
  car.ResetTo({0.49, 0.05});
  const StepResult result = car.Step(Discrete(2));
  EXPECT_TRUE(result.terminated);
  EXPECT_EQ(result.reward, -1.0);
  car.ResetTo({0.59, -0.02});
  EXPECT_FALSE(car.Step(Discrete(0)).terminated);
}

TEST(AcrobotTest, WrapsAnglesAndBoundsVelocities) {
  Acrobot acrobot;
  acrobot.ResetTo({3.1, -3.1, 12.5, -28.2});
  acrobot.Step(Discrete(2));
  EXPECT_THAT(acrobot.state().subspan(0, 2), Each(AllOf(Ge(-3.14159266), Le(3.14159266))));
  EXPECT_THAT(acrobot.state()[2], AllOf(Ge(-12.5663707), Le(12.5663707)));
  EXPECT_THAT(acrobot.state()[3], AllOf(Ge(-28.2743339), Le(28.2743339)));
}

TEST(AcrobotTest, LastStepCostsNothing) {
  Acrobot acrobot;
  acrobot.ResetTo({3.0, 0.0, 0.0, 0.0});  // nearly upright: the tip is high above the bar
  const StepResult last = acrobot.Step(Discrete(1));
  EXPECT_TRUE(last.terminated);
  EXPECT_EQ(last.reward, 0.0);
  acrobot.Reset(0);
  EXPECT_EQ(acrobot.Step(Discrete(1)).reward, -1.0);
}

TEST(PendulumTest, BoundsTheSpeedAndLeavesTheAngleUnwrapped) {
  Pendulum pendulum;
  pendulum.ResetTo({7.0, 7.99});
  EXPECT_EQ(pendulum.Step(Continuous(2.0F)).observation[2], 8.0F);
  EXPECT_DOUBLE_EQ(pendulum.state()[0], 7.4);
}

TEST(PendulumTest, RewardIsTheCostOfTheStateBeforeTheStep) {
  Pendulum pendulum;
  pendulum.ResetTo({0.5, -2.0});
  EXPECT_NEAR(pendulum.Step(Continuous(-2.0F)).reward, -(0.25 + 0.4 + 0.004), 1e-9);
}

TEST(PositionOnlyTest, HidesTheVelocitiesAndChangesNothingElse) {
  for (const auto& [id, hidden, kept] :
       {std::tuple{"CartPole-v1", "PositionOnlyCartPole-v1", std::vector<int>{0, 2}},
        {"Pendulum-v1", "PositionOnlyPendulum-v1", std::vector<int>{0, 1}}}) {
    const auto whole = Make(id), part = Make(hidden);
    const Action action = whole->action_space().is_discrete() ? Discrete(1) : Continuous(0.5F);
    whole->Reset(3);
    part->Reset(3);
    for (StepResult seen; !seen.done();) {
      seen = whole->Step(action);
      const StepResult shown = part->Step(action);
      EXPECT_EQ(shown.observation,
                (std::vector<float>{seen.observation[kept[0]], seen.observation[kept[1]]}));
      EXPECT_EQ(shown.reward, seen.reward);
      EXPECT_EQ(shown.terminated, seen.terminated);
      EXPECT_EQ(shown.truncated, seen.truncated);
    }
    EXPECT_EQ(whole->state(), part->state());
  }
}

TEST(ParametersTest, ChangeTheDynamics) {
  CartPole reversed({.force = -10.0});
  CartPole usual;
  usual.Reset(0);
  reversed.Reset(0);
  EXPECT_EQ(reversed.Step(Discrete(0)).observation, usual.Step(Discrete(1)).observation);
}

}  // namespace
}  // namespace spikeserve
