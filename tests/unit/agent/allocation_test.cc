// Tests that a decision allocates no memory once its session and its thread have made enough
// decisions.
//
// A program of its own, since it replaces operator new and malloc.

#include <gtest/gtest.h>

#include <optional>

#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {

int64_t Allocations();  // of this thread since it has started: allocation_counter.cc

namespace {

struct Case {
  std::string name;
  ActionSpace action_space;
  ActionSelection selection;
  std::optional<LearningOptions> learning = std::nullopt;
};

class AllocationTest : public ::testing::TestWithParam<Case> {};

TEST_P(AllocationTest, AWarmDecisionAllocatesNothing) {
  constexpr int64_t kWarm = 60;  // until the history is full and every buffer has its final size
  constexpr int64_t kCounted = 60;
  const auto served = Serve(ModelConfig(), GetParam().action_space);
  FakeClock clock;
  SessionOptions options = SmallOptions();
  options.action_selection = GetParam().selection;
  options.learning = GetParam().learning;
  AgentSession agent(served, NewSession("id", std::move(options)), &clock);
  const std::vector<float> observation = ObservationAt(0);
  for (int64_t step = 0; step < kWarm + kCounted; ++step) {
    const int64_t before = Allocations();
    const bool answered = agent.Act(step, observation, 0.1).ok();
    agent.AppendPendingAction();
    const int64_t allocated = Allocations() - before;
    ASSERT_TRUE(answered);
    if (step < kWarm) continue;
    ASSERT_EQ(allocated, 0) << "step " << step;
  }
}

constexpr ActionSelection kSampled = {.sample = true, .temperature = 1.0f};
constexpr LearningOptions kRealized = {.modulator = Modulator::kRealized};
constexpr LearningOptions kTarget = {.modulator = Modulator::kTarget, .learning_rate = 1e-3};
constexpr LearningOptions kFleet = {.scope = Scope::kFleet, .modulator = Modulator::kTarget};
constexpr LearningOptions kHebbian = {.rule = Rule::kHebbian, .modulator = Modulator::kTarget};

INSTANTIATE_TEST_SUITE_P(
    Cases, AllocationTest,
    ::testing::Values(Case{"Greedy", ActionSpace::Discrete(3), {}},
                      Case{"Sampled", ActionSpace::Discrete(3), kSampled},
                      Case{"Box", ActionSpace::Box({-2.0f, 0.0f}, {2.0f, 1.0f}), {}},
                      Case{"SampledBox", ActionSpace::Box({-2.0f}, {2.0f}), kSampled},
                      Case{"LearnsRealized", ActionSpace::Discrete(3), kSampled, kRealized},
                      Case{"LearnsTarget", ActionSpace::Discrete(3), kSampled, kTarget},
                      Case{"LearnsInAFleet", ActionSpace::Discrete(3), kSampled, kFleet},
                      Case{"LearnsABox", ActionSpace::Box({-2.0f}, {2.0f}), kSampled, kTarget},
                      Case{"LearnsHebbian", ActionSpace::Box({-2.0f}, {2.0f}), {}, kHebbian}),
    [](const auto& test) { return test.param.name; });

}  // namespace
}  // namespace spikeserve
