// Tests of the functions of spikectl, without running the program.
#include <algorithm>
#include <vector>

#include "client/spikectl/agent.h"
#include "client/spikectl/distance.h"
#include "client/spikectl/policy_choice.h"
#include "client/spikectl/run_report.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/support/fake_policy_service.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

TEST(CheckFitsTest, ComparesObservationsAndActions) {
  const auto cart_pole = *MakeEnvironment("CartPole-v1");
  const auto pendulum = *MakeEnvironment("Pendulum-v1");
  v1::PolicyInfo policy;
  policy.set_name("cartpole");
  policy.set_observation_size(4);
  policy.mutable_action_space()->mutable_discrete()->set_n(2);
  EXPECT_TRUE(CheckSpacesMatch(policy, *cart_pole).ok());
  EXPECT_THAT(CheckSpacesMatch(policy, *pendulum).message(), HasSubstr("observations of length 4"));
  policy.mutable_action_space()->mutable_discrete()->set_n(3);
  EXPECT_THAT(CheckSpacesMatch(policy, *cart_pole).message(), HasSubstr("action space"));

  policy.set_observation_size(3);
  policy.mutable_action_space()->mutable_box()->add_low(-2.0f);
  policy.mutable_action_space()->mutable_box()->add_high(2.0f);
  EXPECT_TRUE(CheckSpacesMatch(policy, *pendulum).ok());
  policy.mutable_action_space()->mutable_box()->set_high(0, 1.0f);
  EXPECT_FALSE(CheckSpacesMatch(policy, *pendulum).ok());
}

class AgentTest : public ::testing::Test {
 protected:
  FakePolicyService fake_;
  std::unique_ptr<Client> client_ = *Client::Create(fake_.channel());
  RemoteSession session_{client_.get(), client_->OpenSession({})->session_id(), 0};
};

TEST_F(AgentTest, TellsTheServerWhatWasExecutedFarAway) {
  const auto environment = *MakeEnvironment("CartPole-v1");
  ASSERT_TRUE(PlayEpisode(*environment, session_, 5).ok());
  EXPECT_FALSE(fake_.last_end_episode().has_executed_action());
  const auto far =
      PlayEpisode(*environment, session_, 5, {.distance = {.delay = 2, .jitter = 3, .loss = 0.3}});
  ASSERT_TRUE(far.ok()) << far.status();
  EXPECT_TRUE(fake_.last_end_episode().executed_action().has_discrete());
}

std::vector<int> Executed(const Distance& distance, int beats) {
  Arrivals arrivals(distance, ActionSpace::Discrete(1000), /*seed=*/0);
  std::vector<int> executed;
  for (int beat = 0; beat < beats; ++beat) {
    executed.push_back(arrivals.Executed({.discrete = beat + 1, .continuous = {}}).discrete);
  }
  return executed;
}

TEST(ArrivalsTest, DecisionsOfAFarServerArriveLater) {
  EXPECT_THAT(Executed({.delay = 2}, 6), ElementsAre(0, 0, 1, 2, 3, 4));
  const std::vector<int> late = Executed({.delay = 1, .jitter = 3, .loss = 0.3}, 60);
  EXPECT_TRUE(std::is_sorted(late.begin(), late.end()));  // an older one never follows a newer one
  for (int beat = 0; beat < 60; ++beat) EXPECT_LE(late[static_cast<size_t>(beat)], beat);
  EXPECT_GT(late.back(), 50);
}

TEST(ArrivalsTest, BeginWithTheNeutralAction) {
  Arrivals arrivals({.delay = 1}, ActionSpace::Box({-1.0f, 2.0f}, {1.0f, 4.0f}), /*seed=*/0);
  const Action decided = {.discrete = 0, .continuous = {0.5f, 2.5f}};
  EXPECT_THAT(arrivals.Executed(decided).continuous, ElementsAre(0.0f, 3.0f));
  EXPECT_THAT(arrivals.Executed(decided).continuous, ElementsAre(0.5f, 2.5f));
}

TEST_F(AgentTest, RefusesAnActionOfAnotherSpace) {
  const auto pendulum = *MakeEnvironment("Pendulum-v1");
  const auto episode = PlayEpisode(*pendulum, session_, 5);
  EXPECT_TRUE(absl::IsInternal(episode.status()));
  EXPECT_THAT(episode.status().message(), HasSubstr("action"));
}

EpisodeRecord Record(double episode_return, int64_t steps, uint64_t spikes) {
  EpisodeRecord record;
  record.episode_return = episode_return;
  record.steps = steps;
  record.spikes = spikes;
  record.joules[static_cast<size_t>(kDefaultEnergyModel)] = 5e-12 * static_cast<double>(spikes);
  record.latency.Add(0.002);
  return record;
}

TEST(RunReportTest, TheTextNamesOneEnergyModelWithMemoryWhereItCounts) {
  std::vector<EpisodeRecord> episodes = {Record(10.0, 10, 1000), Record(30.0, 30, 6000)};
  EXPECT_THAT(RunTableLine(12, episodes[0]), HasSubstr(" 0.50 nJ"));
  const std::string summary = RunSummary(episodes);
  EXPECT_THAT(summary, HasSubstr("mean return 20.0 +- 10.0 over 2 episodes, 40 decisions"));
  EXPECT_THAT(summary,
              HasSubstr("0.87 nJ a decision by the estimate horowitz_45nm, without memory\n"));
  for (EpisodeRecord& episode : episodes) {  // in integers
    episode.joules[static_cast<size_t>(EnergyModel::kIntSram45nm)] = 4e-8;
    episode.joules[static_cast<size_t>(EnergyModel::kInt45nm)] = 2e-8;
  }
  EXPECT_THAT(RunSummary(episodes), HasSubstr("2.00 nJ a decision by the estimate int_sram_45nm, "
                                              "1.00 nJ without memory (int_45nm)\n"));
}

}  // namespace
}  // namespace spikeserve
