// Tests that do not need Gymnasium. The tests in tests/python compare the dynamics with
// Gymnasium's, step by step.
#include "core/environment/environment.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <memory>
#include <string>
#include <tuple>
#include <vector>

#include "core/environment/classic_tasks.h"
#include "core/environment/perturbation.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

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

constexpr double kPi = 3.14159265358979323846;

Action Push(int discrete) { return {.discrete = discrete, .continuous = {}}; }

// Returns one component of the internal state after one step from `state`.
double Next(const std::string& id, const std::string& perturb, std::vector<double> state,
            const Action& action, size_t component) {
  auto environment = perturb.empty() ? MakeEnvironment(id)
                                     : MakePerturbedEnvironment(id, *ParsePerturbation(perturb));
  EXPECT_TRUE(environment.ok()) << environment.status();
  (*environment)->Reset(0);
  (*environment)->ResetTo(state);
  (void)(*environment)->Step(action);
  return (*environment)->state()[component];
}

TEST(ParsePerturbationTest, TakesANameAndAFiniteNumber) {
  const auto parsed = ParsePerturbation("force=-1.5");
  ASSERT_TRUE(parsed.ok());
  EXPECT_EQ(parsed->name, "force");
  EXPECT_EQ(parsed->value, -1.5);
  for (const char* text : {"", "force", "force=", "force=x", "force=nan", "force=inf", "=1x"}) {
    EXPECT_THAT(std::string(ParsePerturbation(text).status().message()),
                HasSubstr("expected NAME=VALUE with a finite number"))
        << text;
  }
}

TEST(PerturbationTest, AFactorOfOneChangesNothing) {
  for (const std::string id : {"CartPole-v1", "MountainCar-v0", "Acrobot-v1", "Pendulum-v1",
                               "PositionOnlyCartPole-v1", "PositionOnlyPendulum-v1"}) {
    for (const std::string name : {"length", "mass", "force", "gravity"}) {
      if (id == "MountainCar-v0" && (name == "length" || name == "mass")) continue;
      const auto plain = MakeEnvironment(id);
      const auto perturbed = MakePerturbedEnvironment(id, {.name = name, .value = 1.0});
      ASSERT_TRUE(perturbed.ok()) << perturbed.status();
      EXPECT_EQ((*perturbed)->id(), id);
      EXPECT_EQ((*perturbed)->Reset(3), (*plain)->Reset(3));
      const Action action = (*plain)->action_space().is_discrete()
                                ? Push(0)
                                : Action{.discrete = 0, .continuous = {1.5f}};
      for (int step = 0; step < 5; ++step) {
        EXPECT_EQ((*perturbed)->Step(action).observation, (*plain)->Step(action).observation)
            << id << " " << name;
      }
    }
  }
}

TEST(PerturbationTest, AReversedActuatorMirrorsThePush) {
  // Each task starts at rest and at the centre of its symmetry, so that only the push moves it.
  EXPECT_EQ(Next("CartPole-v1", "force=-1", {0, 0, 0, 0}, Push(0), 1),
            Next("CartPole-v1", "", {0, 0, 0, 0}, Push(1), 1));
  EXPECT_EQ(Next("Acrobot-v1", "force=-1", {0, 0, 0, 0}, Push(0), 3),
            Next("Acrobot-v1", "", {0, 0, 0, 0}, Push(2), 3));
  EXPECT_EQ(Next("MountainCar-v0", "force=-1", {-0.5, 0}, Push(0), 1),
            Next("MountainCar-v0", "", {-0.5, 0}, Push(2), 1));
  const auto torque = [](float value) { return Action{.discrete = 0, .continuous = {value}}; };
  EXPECT_EQ(Next("Pendulum-v1", "force=-1", {0, 0}, torque(1.5f), 1),
            Next("Pendulum-v1", "", {0, 0}, torque(-1.5f), 1));
  EXPECT_EQ(Next("PositionOnlyCartPole-v1", "force=-1", {0, 0, 0, 0}, Push(0), 1),
            Next("CartPole-v1", "", {0, 0, 0, 0}, Push(1), 1));
}

TEST(PerturbationTest, WindPushesTheCartToTheRight) {
  // A push of 10 N to the left cancels a wind of 10 N: the cart does not move.
  EXPECT_EQ(Next("CartPole-v1", "wind=10", {0, 0, 0, 0}, Push(0), 1), 0.0);
  EXPECT_GT(Next("CartPole-v1", "wind=11", {0, 0, 0, 0}, Push(0), 1), 0.0);
}

TEST(PerturbationTest, GravityScalesTheFall) {
  // From rest and without a push, the acceleration in Gymnasium's equations is proportional to
  // gravity.
  const auto torque = Action{.discrete = 0, .continuous = {0.0f}};
  const double plain = Next("Pendulum-v1", "", {kPi / 2, 0}, torque, 1);
  EXPECT_NEAR(Next("Pendulum-v1", "gravity=1.3", {kPi / 2, 0}, torque, 1), 1.3 * plain, 1e-12);
  EXPECT_NEAR(Next("MountainCar-v0", "gravity=2", {-0.6, 0}, Push(1), 1),
              2 * Next("MountainCar-v0", "", {-0.6, 0}, Push(1), 1), 1e-12);
  EXPECT_EQ(Next("MountainCar-v0", "gravity=0", {-0.6, 0}, Push(1), 1), 0.0);
}

TEST(PerturbationTest, LengthAndMassAreThoseOfThePendulumsEquation) {
  // Gymnasium: dw = (3 g / 2l sin(theta) + 3 / (m l^2) u) dt.
  const auto torque = Action{.discrete = 0, .continuous = {1.0f}};
  const auto expected = [](double mass, double length) {
    return (3 * 10.0 / (2 * length) * std::sin(1.0) + 3.0 / (mass * length * length)) * 0.05;
  };
  EXPECT_NEAR(Next("Pendulum-v1", "mass=2", {1.0, 0}, torque, 1), expected(2, 1), 1e-12);
  EXPECT_NEAR(Next("Pendulum-v1", "length=2", {1.0, 0}, torque, 1), expected(1, 2), 1e-12);
}

TEST(PerturbationTest, AnglesOfAbsurdPhysicsAreWrapped) {
  for (const char* perturb : {"gravity=1e6", "gravity=1e200", "length=1e-5"}) {
    const double angle = Next("Acrobot-v1", perturb, {0.1, 0.1, 0, 0}, Push(2), 0);
    EXPECT_FALSE(std::abs(angle) > kPi) << perturb;
  }
}

TEST(PerturbationTest, SaysWhatATaskHas) {
  const auto message = [](const std::string& id, const Perturbation& perturbation) {
    return std::string(MakePerturbedEnvironment(id, perturbation).status().message());
  };
  EXPECT_THAT(message("MountainCar-v0", {.name = "wind", .value = 4}),
              HasSubstr("expected one of force, gravity for MountainCar-v0, received \"wind\""));
  EXPECT_THAT(message("Pendulum-v1", {.name = "mass", .value = 0}),
              HasSubstr("expected a mass above 0, received 0"));
  EXPECT_THAT(message("PositionOnlyCartPole-v1", {.name = "heat", .value = 1}),
              HasSubstr("expected one of wind, length, mass, force, gravity for CartPole-v1"));
  EXPECT_THAT(message("PositionOnlyPendulum-v1", {.name = "wind", .value = 1}),
              HasSubstr("expected one of length, mass, force, gravity for Pendulum-v1"));
  EXPECT_THAT(message("Pong-v0", {.name = "mass", .value = 1}), HasSubstr("Pong-v0"));
}

}  // namespace
}  // namespace spikeserve
