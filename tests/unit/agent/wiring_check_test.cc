#include "core/agent/wiring_check.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "core/math/counter_random.h"
#include "core/model/wiring_fit.h"
#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

using Observation = std::vector<float>;
using Wire = std::function<void(Observation&)>;

// A cart that two actions push, and a pendulum that hangs from it.
class Robot {
 public:
  explicit Robot(uint64_t seed) : seed_(seed) {
    for (double& element : state_) element = 0.4 * Draw();
  }
  Observation observation() const { return {state_, state_ + 4}; }
  int action() { return Draw() + 0.3 * state_[1] > 0.0 ? 0 : 1; }
  void Step(int action) {
    const double push = action == 1 ? 0.1 : -0.1;
    const double angle = state_[2];
    state_[0] += 0.1 * state_[1];
    state_[1] += push - 0.02 * state_[0] + 0.002 * Draw();
    state_[2] += 0.1 * state_[3];
    state_[3] += -0.3 * angle + 0.05 * angle * state_[1] - 0.4 * push + 0.002 * Draw();
  }

 private:
  double Draw() { return 2.0 * UniformDouble(RandomBits({seed_, draws_++})) - 1.0; }

  const uint64_t seed_;
  uint64_t draws_ = 0;
  double state_[4];
};

class WiringCheckTest : public testing::Test {
 protected:
  WiringCheckTest() {
    WiringFit fit(4, 2);
    for (uint64_t seed = 0; seed < 30; ++seed) {
      Robot robot(seed);
      Observation observations = robot.observation();
      std::vector<float> actions;
      for (int t = 0; t < 100; ++t) {
        const int action = robot.action();
        robot.Step(action);
        actions.insert(actions.end(), {action == 0 ? 1.0f : 0.0f, action == 1 ? 1.0f : 0.0f});
        const Observation next = robot.observation();
        observations.insert(observations.end(), next.begin(), next.end());
      }
      fit.Add(observations, actions);
    }
    policy_.wiring = std::make_shared<const WiringModel>(*fit.Finish());
    policy_.features = *ParseFeatures(R"({"observation": ["x", "v", "angle", "rate"]})");
  }

  // Plays an episode of `steps` and returns the step of the first verdict; -1: there was none.
  int Play(WiringState* state, uint64_t seed, int steps, const Wire& wire) {
    Robot robot(seed);
    History history;
    int first = -1;
    for (int t = 0; t < steps; ++t) {
      Observation observation = robot.observation();
      wire(observation);
      if (CheckWiring(policy_, t, history, observation, state) && first < 0) first = t;
      const int chosen = robot.action();
      history.Append(0.0f, observation, {.discrete = chosen, .continuous = {}}, /*limit=*/2);
      robot.Step(chosen);
    }
    return first;
  }

  // Expects a verdict with `text` within 50 steps of each of ten sessions.
  void ExpectVerdict(const Wire& wire, const std::string& text) {
    for (uint64_t seed = 100; seed < 110; ++seed) {
      WiringState state;
      const int first = Play(&state, seed, 51, wire);
      ASSERT_GE(first, 0) << text << ", seed " << seed;
      EXPECT_EQ(WiringText(policy_, *state.verdict), text) << "seed " << seed;
    }
  }

  Policy policy_ = SmallPolicy();
};

TEST_F(WiringCheckTest, NamesEveryExchangeAndEverySign) {
  const std::string named[] = {"observation[0] (x)", "observation[1] (v)", "observation[2] (angle)",
                               "observation[3] (rate)"};
  for (size_t i = 0; i < 4; ++i) {
    ExpectVerdict([i](Observation& x) { x[i] = -x[i]; },
                  named[i] + " looks as if it had the other sign");
    for (size_t j = i + 1; j < 4; ++j) {
      ExpectVerdict([i, j](Observation& x) { std::swap(x[i], x[j]); },
                    named[i] + " and " + named[j] + " look exchanged");
    }
  }
}

TEST_F(WiringCheckTest, NamesDegreesAndADeadElement) {
  ExpectVerdict([](Observation& x) { x[2] *= 57.29578f; },
                "observation[2] (angle) looks like degrees, expected radians");
  WiringState state;
  Play(&state, 1, 60, [](Observation& x) { x[1] = 0.25f; });
  ASSERT_TRUE(state.verdict.has_value());
  EXPECT_EQ(WiringText(policy_, *state.verdict), "observation[1] (v) has not changed for 50 steps");
}

TEST_F(WiringCheckTest, CleanSessionsGetNoVerdict) {
  for (uint64_t seed = 1000; seed < 1200; ++seed) {
    WiringState state;
    EXPECT_EQ(Play(&state, seed, 500, [](Observation&) {}), -1) << "seed " << seed;
  }
}

TEST_F(WiringCheckTest, NothingIsRememberedOfUsualSteps) {
  for (uint64_t seed = 1000; seed < 1020; ++seed) {
    WiringState state;
    Play(&state, seed, 60, [](Observation&) {});
    EXPECT_EQ(state, WiringState()) << "seed " << seed;
  }
}

// As the releases before the watch stored it: a window is open from the first step on.
TEST_F(WiringCheckTest, AnOpenWindowOfTheReleaseBeforeGoesOn) {
  WiringState stored;
  stored.is_open = true;
  for (uint16_t number = 0; number < 15; ++number) stored.hypotheses.push_back({.number = number});
  ASSERT_TRUE(CheckWiringState(policy_, stored).ok());
  WiringState wrong = stored;
  EXPECT_GE(Play(&wrong, 3, 51, [](Observation& x) { x[1] = -x[1]; }), 0);
  EXPECT_EQ(WiringText(policy_, *wrong.verdict),
            "observation[1] (v) looks as if it had the other sign");
  EXPECT_EQ(Play(&stored, 3, 110, [](Observation&) {}), -1);
  EXPECT_EQ(stored, WiringState());
}

TEST_F(WiringCheckTest, AStandstillGetsNoVerdictAboutTheWiring) {
  WiringState state;
  History history;
  const Observation zero(4, 0.0f);
  for (int t = 0; t < 40; ++t) {
    CheckWiring(policy_, t, history, zero, &state);
    history.Append(0.0f, zero, {.discrete = t % 2, .continuous = {}}, /*limit=*/2);
  }
  ASSERT_TRUE(state.verdict.has_value());
  EXPECT_EQ(state.verdict->cause, WiringCause::kDynamics);
}

TEST_F(WiringCheckTest, AVerdictIsWithdrawnWhenTheRobotIsWiredRight) {
  WiringState state;
  EXPECT_GE(Play(&state, 5, 50, [](Observation& x) { std::swap(x[0], x[3]); }), 0);
  ASSERT_TRUE(state.verdict.has_value());
  Play(&state, 6, 200, [](Observation&) {});
  EXPECT_FALSE(state.verdict.has_value()) << WiringText(policy_, *state.verdict);
}

}  // namespace
}  // namespace spikeserve
