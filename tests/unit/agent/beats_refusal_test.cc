// Tests of the histories that a session refuses.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <string>
#include <utility>
#include <vector>

#include "core/agent/agent_session.h"
#include "core/agent/repeated_step.h"
#include "core/journal/session_bytes.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

PastSteps HistoryOf(const std::vector<PastStep>& past) {
  return {.size = past.size(), .source = past.data(), .read = [](const void* source, size_t i) {
            return static_cast<const PastStep*>(source)[i];
          }};
}

struct DoneBeat {
  std::vector<float> observation;
  double reward;
  Action executed;
};

// Each history is refused, and the session is as it was.
TEST(BeatsRefusalTest, NothingIsHalfApplied) {
  FakeClock clock;
  const ActionSpace space = ActionSpace::Discrete(3);
  AgentSession agent(Serve(SmallConfig(), space), NewSession("id", SmallOptions()), &clock);
  for (int64_t t = 0; t < 2; ++t) ASSERT_TRUE(agent.Act(t, ObservationAt(t), RewardAt(t)).ok());
  const std::string before = SerializeSession(agent.session());
  const std::vector<float> known = ObservationAt(1);
  const std::vector<float> good = ObservationAt(5);
  std::vector<PastStep> beats;
  for (int64_t step = 1; step < 5; ++step) {
    beats.push_back({.step = step,
                     .observation = step == 1 ? known : good,
                     .reward = RewardAt(step),
                     .executed = int64_t{step % 3}});
  }
  struct Change {
    std::string expected;
    absl::StatusCode code;
    std::function<void(std::vector<PastStep>&, Step&)> make;
  };
  const auto kInvalid = absl::StatusCode::kInvalidArgument;
  const auto kPlace = absl::StatusCode::kFailedPrecondition;
  static const std::vector<float> kShort = {1.0f};
  static const std::vector<double> kRewards = {std::nan("")};
  const std::vector<Change> changes = {
      {"history[3]: observation: expected 3 numbers, received 1", kInvalid,
       [](auto& all, auto&) { all[3].observation = kShort; }},
      {"history[2]: reward: expected a finite number", kInvalid,
       [](auto& all, auto&) { all[2].reward = INFINITY; }},
      {"history[0]: executed_action: expected an index from 0 to 2, received index 3", kInvalid,
       [](auto& all, auto&) { all[0].executed = int64_t{3}; }},
      {"history[3]: executed_action: expected an index from 0 to 2, received none", kInvalid,
       [](auto& all, auto&) { all[3].executed = std::monostate(); }},
      {"history[2]: step: expected 3, received 4", kInvalid,
       [](auto& all, auto&) { all[2].step = 4; }},
      {"observation: expected 3 numbers, received 1", kInvalid,
       [](auto&, auto& history) { history.observation = kShort; }},
      {"decision: expected the number of the decision", kInvalid,
       [](auto&, auto& history) { history.place.decision = std::nullopt; }},
      {"decision: expected 2 for step 2, received 9 for step 5", kPlace,
       [](auto&, auto& history) { history.place.decision = 9; }},
      {"history: expected beats from step 2 on, received those from step 3 on", kPlace,
       [](auto& all, auto&) { all.erase(all.begin(), all.begin() + 2); }},
      {"skipped_rewards[0]: reward: expected a finite number", kInvalid,
       [](auto& all, auto& history) {
         all.erase(all.begin(), all.begin() + 2);
         history.skipped_rewards = kRewards;
       }},
      {"history: expected at least one beat behind skipped_rewards, received none", kInvalid,
       [](auto& all, auto& history) {
         all.clear();
         history.skipped_rewards = kRewards;
       }}};
  for (const Change& change : changes) {
    std::vector<PastStep> changed = beats;
    Step step = {
        .session = &agent, .place = {.decision = 5, .step = 5}, .observation = good, .reward = 1.0};
    change.make(changed, step);
    step.history = HistoryOf(changed);
    AgentSession::Apply({&step});
    const absl::Status& status = step.result.status;
    EXPECT_EQ(status.code(), change.code) << change.expected << ": " << status;
    EXPECT_THAT(std::string(status.message()), HasSubstr(change.expected));
    EXPECT_EQ(SerializeSession(agent.session()), before) << change.expected;
  }
}

// A store may have lost the last decision of a session, and what was executed before it.
TEST(BeatsRefusalTest, AStoredSessionIsToldWhatWasExecutedBeforeIt) {
  FakeClock clock;
  const std::vector<float> observation = ObservationAt(5);
  for (const Durability durability : {Durability::kNone, Durability::kAsync, Durability::kSync}) {
    SessionOptions options = SmallOptions();
    options.durability = durability;
    AgentSession agent(Serve(SmallConfig(), ActionSpace::Discrete(3)),
                       NewSession("id", std::move(options)), &clock);
    const auto append = [&](int64_t first, int64_t last, std::vector<double> skipped) {
      std::vector<PastStep> past;
      for (int64_t step = first; step <= last; ++step) {
        past.push_back(
            {.step = step, .observation = observation, .reward = 1.0, .executed = int64_t{2}});
      }
      Step step = {.session = &agent,
                   .place = {.decision = static_cast<uint64_t>(last + 1), .step = last + 1},
                   .skipped_rewards = skipped,
                   .history = HistoryOf(past)};
      AgentSession::Apply({&step});
      return step.result.status;
    };
    EXPECT_TRUE(append(0, 1, {}).ok());  // before step 0 nothing was executed
    const std::string before = SerializeSession(agent.session());
    const auto late = append(2, 3, {});
    if (durability == Durability::kNone) {
      EXPECT_TRUE(late.ok()) << late;
      continue;
    }
    EXPECT_EQ(late.code(), absl::StatusCode::kFailedPrecondition);
    EXPECT_THAT(std::string(late.message()),
                HasSubstr("history: expected beats from step 1 on, received those from step 2 on"));
    EXPECT_EQ(SerializeSession(agent.session()), before);
    EXPECT_TRUE(append(1, 3, {}).ok());
    EXPECT_EQ(agent.session().history.action(1).discrete, 2);
    EXPECT_FALSE(append(4, 5, {1.0}).ok());  // of a step that it has
    EXPECT_TRUE(append(5, 5, {1.0}).ok());   // the context begins behind what is not known
    EXPECT_EQ(agent.session().history.size(), 1u);
  }
}

TEST(BeatsRefusalTest, BeatsThatTheSessionHasAreCompared) {
  FakeClock clock;
  AgentSession agent(Serve(SmallConfig(), ActionSpace::Discrete(3)),
                     NewSession("id", SmallOptions()), &clock);
  std::vector<DoneBeat> done;
  for (int64_t t = 0; t < 4; ++t) {
    done.push_back({ObservationAt(t), RewardAt(t), {.discrete = 1, .continuous = {}}});
  }
  const auto append = [&](const std::vector<DoneBeat>& beats) {
    std::vector<PastStep> past;
    for (const DoneBeat& beat : beats) {
      past.push_back({.step = static_cast<int64_t>(past.size()),
                      .observation = beat.observation,
                      .reward = beat.reward,
                      .executed = int64_t{beat.executed.discrete}});
    }
    Step step = {.session = &agent,
                 .place = {.decision = past.size(), .step = static_cast<int64_t>(past.size())},
                 .history = HistoryOf(past)};
    AgentSession::Apply({&step});
    return step.result.status;
  };
  ASSERT_TRUE(append(done).ok());
  const std::string before = SerializeSession(agent.session());
  const auto refuse = [&](const std::string& message, auto change) {
    std::vector<DoneBeat> other = done;
    other.push_back(done.back());
    change(other);
    absl::Status status = append(other);
    EXPECT_TRUE(TakeConflict(&status)) << status;
    EXPECT_THAT(std::string(status.message()), HasSubstr(message));
    EXPECT_EQ(SerializeSession(agent.session()), before);
  };
  refuse("history[3]: observation[0]: expected ", [](auto& all) { all[3].observation[0] = 0.5f; });
  refuse("history[2]: observation: expected 3 numbers", [](auto& all) { all[2].observation = {}; });
  refuse("history[1]: reward: expected about 0.1", [](auto& all) { all[1].reward = 3.0; });
  refuse("history[3]: executed_action: expected index 1 ",
         [](auto& all) { all[2].executed.discrete = 2; });
  // What was executed last is new.
  done.back().executed.discrete = 2;
  done.push_back(done.back());
  EXPECT_TRUE(append(done).ok());
}

}  // namespace
}  // namespace spikeserve
