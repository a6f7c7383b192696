#include "core/agent/session_listener.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <memory>
#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/agent/agent_session.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;

// Writes what it is called for behind its name.
class NotingListener final : public SessionListener {
 public:
  NotingListener(std::string name, std::vector<std::string>* notes, bool takes = false)
      : name_(std::move(name)), notes_(*notes), takes_(takes) {}

  void OnDecision(const Session& session, const DecisionInputs& inputs) override {
    Note(absl::StrCat("decision ", session.decisions - 1, inputs.executed ? " executed" : "",
                      inputs.after_gap ? " after gap" : "", inputs.is_beat ? " beat" : ""));
  }
  void OnExecuted(const Action& executed) override {
    Note(absl::StrCat("executed ", executed.discrete));
  }
  void OnChange(const Session& /*session*/) override { Note("change"); }
  void OnGap() override { Note("gap"); }
  bool OnEpisodeEnd(const Session& session,
                    const std::shared_ptr<FleetContribution>& contribution) override {
    Note(absl::StrCat("end ", session.last_end->summary.steps,
                      contribution != nullptr ? " contribution" : ""));
    return takes_;
  }

 private:
  void Note(const std::string& what) { notes_.push_back(absl::StrCat(name_, ": ", what)); }

  const std::string name_;
  std::vector<std::string>& notes_;
  const bool takes_;
};

// Counts what is appended.
class CountingLog final : public HeadLog {
 public:
  explicit CountingLog(std::shared_ptr<TenantHeads> heads) : heads_(std::move(heads)) {}

  std::shared_ptr<TenantHeads> heads() const override { return heads_; }
  void Append(std::shared_ptr<FleetContribution> /*contribution*/) override { ++appended_; }
  absl::Status CatchUp() override { return absl::OkStatus(); }
  absl::StatusOr<double> Rollback(const std::string& /*tenant*/) override { return 0.0; }
  absl::Status SetPaused(bool /*paused*/) override { return absl::OkStatus(); }

  int appended() const { return appended_; }

 private:
  const std::shared_ptr<TenantHeads> heads_;
  int appended_ = 0;
};

class SessionListenerTest : public ::testing::Test {
 protected:
  FakeClock clock_;
  std::shared_ptr<const ServedPolicy> served_ = Serve(SmallConfig(), ActionSpace::Discrete(2));
  std::vector<std::string> notes_;
};

TEST_F(SessionListenerTest, IsCalledOnceForEveryEventInTheOrderOfAddition) {
  AgentSession agent(served_, NewSession("id", SmallOptions()), &clock_);
  agent.AddListener(std::make_shared<NotingListener>("a", &notes_));
  agent.AddListener(std::make_shared<NotingListener>("b", &notes_));
  for (int attempt = 0; attempt < 2; ++attempt) {
    ASSERT_TRUE(agent.Act(0, ObservationAt(0), 0.0).ok());
  }
  for (int attempt = 0; attempt < 2; ++attempt) {
    ASSERT_TRUE(agent.EndEpisode({.reward = 1.0, .terminated = true}).ok());
  }
  EXPECT_FALSE(agent.Act(7, ObservationAt(7), 0.0).ok());
  EXPECT_THAT(notes_, ElementsAre("a: decision 0", "b: decision 0", "a: end 1", "b: end 1"));
}

TEST_F(SessionListenerTest, IsCalledForWhatTheAgentDidWithoutTheServer) {
  AgentSession agent(served_, NewSession("id", SmallOptions()), &clock_);
  agent.AddListener(std::make_shared<NotingListener>("a", &notes_));
  const auto other = [&] { return 1 - agent.session().last_answer->action.discrete; };
  ASSERT_TRUE(agent.Act(0, ObservationAt(0), 0.0).ok());
  int64_t executed = other();
  ASSERT_TRUE(agent.Act(1, ObservationAt(1), 0.0, ReportedAction(executed)).ok());
  const std::string first = absl::StrCat("a: executed ", executed);
  executed = other();
  ASSERT_TRUE(agent.AddBlindStep(0.5, executed).ok());
  const std::string second = absl::StrCat("a: executed ", executed);
  const std::vector<float> observation = ObservationAt(3);
  const auto beat = [](const void* source, size_t /*i*/) {
    return PastStep{.step = 3,
                    .observation = *static_cast<const std::vector<float>*>(source),
                    .executed = int64_t{0}};
  };
  const std::vector<double> skipped = {0.5};
  Step history = {.session = &agent,
                  .place = {.decision = 4, .step = 4},
                  .skipped_rewards = skipped,
                  .history = {.size = 1, .source = &observation, .read = beat}};
  AgentSession::Apply({&history});
  ASSERT_TRUE(history.result.status.ok()) << history.result.status;
  EXPECT_THAT(notes_,
              ElementsAre("a: decision 0", first, "a: decision 1 executed", second, "a: change",
                          "a: gap", "a: decision 3 after gap beat", "a: executed 0", "a: change"));
}

TEST_F(SessionListenerTest, AContributionIsAppendedUnlessAListenerTakesIt) {
  for (const bool takes : {false, true}) {
    auto served = std::make_shared<ServedPolicy>(*served_);
    auto log = std::make_shared<CountingLog>(std::make_shared<TenantHeads>(
        std::shared_ptr<const Policy>(served->engine, &served->policy())));
    served->log = log;
    SessionOptions options = SmallOptions();
    options.learning = LearningOptions{.scope = Scope::kFleet};
    AgentSession agent(served, NewSession("id", options), &clock_);
    agent.AddListener(std::make_shared<NotingListener>("a", &notes_, takes));
    ASSERT_TRUE(agent.Act(0, ObservationAt(0), 0.0).ok());
    ASSERT_TRUE(agent.EndEpisode({.reward = 1.0, .terminated = true}).ok());
    EXPECT_EQ(notes_.back(), "a: end 1 contribution");
    EXPECT_EQ(log->appended(), takes ? 0 : 1);
  }
}

}  // namespace
}  // namespace spikeserve
