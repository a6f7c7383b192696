// Tests that do not need Gymnasium. The tests in tests/python compare the dynamics with
// Gymnasium's, step by step.
#include "core/environment/environment.h"

#include <gtest/gtest.h>

#include <memory>
#include <string>
#include <tuple>
#include <vector>

#include "core/environment/classic_tasks.h"

namespace spikeserve {
namespace {

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

TEST(TruncationTest, LastStepMayTerminateAndTruncate) {
  // Without gravity and force the cart moves at a constant velocity and passes 2.4 m at step 500.
  const auto coasting = MakeCartPole({.gravity = 0.0, .force = 0.0});
  coasting->ResetTo({0.0, 0.2402, 0.0, 0.0});
  int steps = 0;
  StepResult last;
  for (; !last.done(); ++steps) last = coasting->Step(Discrete(0));
  EXPECT_EQ(steps, 500);
  EXPECT_TRUE(last.truncated);
  EXPECT_TRUE(last.terminated);
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

}  // namespace
}  // namespace spikeserve
