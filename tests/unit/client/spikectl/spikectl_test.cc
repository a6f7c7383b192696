// Tests of the functions of spikectl, without running the program.
#include <algorithm>
#include <vector>

#include "client/spikectl/agent.h"
#include "client/spikectl/distance.h"
#include "client/spikectl/policy_choice.h"
#include "client/spikectl/run_report.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "spikeserve/status.h"
#include "tests/support/fake_policy_service.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

v1::PolicyInfo Served(const std::string& name, int version, bool is_default,
                      const std::string& environment) {
  v1::PolicyInfo policy;
  policy.set_name(name);
  policy.set_version(version);
  policy.set_is_default(is_default);
  policy.set_environment(environment);
  return policy;
}

v1::ListPoliciesResponse ServedPolicies() {
  v1::ListPoliciesResponse served;
  *served.add_policies() = Served("acrobot", 1, true, "Acrobot-v1");
  *served.add_policies() = Served("cartpole", 1, false, "CartPole-v1");
  *served.add_policies() = Served("cartpole", 2, true, "CartPole-v1");
  *served.add_policies() = Served("cartpole-pos", 1, true, "CartPole-v1");
  return served;
}

TEST(ChoosePolicyTest, TakesTheDefaultVersionForTheEnvironment) {
  const auto policy = ChoosePolicy(ServedPolicies(), "CartPole-v1", "", 0);
  ASSERT_TRUE(policy.ok()) << policy.status();
  EXPECT_EQ(policy->name(), "cartpole");
  EXPECT_EQ(policy->version(), 2);
}

TEST(ChoosePolicyTest, TakesWhatIsNamed) {
  EXPECT_EQ(ChoosePolicy(ServedPolicies(), "CartPole-v1", "cartpole-pos", 0)->name(),
            "cartpole-pos");
  EXPECT_EQ(ChoosePolicy(ServedPolicies(), "CartPole-v1", "cartpole", 1)->version(), 1);
  // A caller may name a policy of another environment.
  EXPECT_EQ(ChoosePolicy(ServedPolicies(), "CartPole-v1", "acrobot", 0)->name(), "acrobot");
}

TEST(ChoosePolicyTest, SaysWhatIsServedInstead) {
  const auto none = ChoosePolicy(ServedPolicies(), "Pendulum-v1", "", 0);
  EXPECT_TRUE(absl::IsNotFound(none.status()));
  EXPECT_THAT(none.status().message(), HasSubstr("no policy for Pendulum-v1 is served"));
  EXPECT_THAT(none.status().message(), HasSubstr("cartpole/2 for CartPole-v1"));
  const auto version = ChoosePolicy(ServedPolicies(), "CartPole-v1", "cartpole", 3);
  EXPECT_THAT(version.status().message(), HasSubstr("no policy \"cartpole\" in version 3"));
  const auto empty = ChoosePolicy({}, "CartPole-v1", "", 0);
  EXPECT_THAT(empty.status().message(), HasSubstr("the server has no policy"));
}

TEST(CheckFitsTest, ComparesObservationsAndActions) {
  const auto cart_pole = *MakeEnvironment("CartPole-v1");
  const auto pendulum = *MakeEnvironment("Pendulum-v1");
  v1::PolicyInfo policy = Served("cartpole", 1, true, "CartPole-v1");
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

TEST_F(AgentTest, PlaysAnEpisodeToItsEnd) {
  const auto environment = *MakeEnvironment("CartPole-v1");
  const auto first = PlayEpisode(*environment, session_, 5);
  ASSERT_TRUE(first.ok()) << first.status();
  EXPECT_GT(first->steps, 0);
  EXPECT_EQ(first->episode_return, static_cast<double>(first->steps));
  EXPECT_EQ(first->steps, fake_.decisions());
  EXPECT_EQ(first->latency.count(), first->steps);
  EXPECT_EQ(first->spikes, FakePolicyService::kSpikes * static_cast<uint64_t>(first->steps));
  EXPECT_TRUE(fake_.last_end_episode().terminated());
  EXPECT_FALSE(fake_.last_end_episode().truncated());
  EXPECT_EQ(fake_.last_end_episode().reward(), 1.0);
  // The session can play another episode.
  EXPECT_TRUE(PlayEpisode(*environment, session_, 6).ok());
}

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

TEST_F(AgentTest, PassesOnTheServersError) {
  const auto environment = *MakeEnvironment("CartPole-v1");
  fake_.RefuseNext(1, {grpc::StatusCode::NOT_FOUND, "session_id: reaped"});
  const absl::Status status = PlayEpisode(*environment, session_, 5).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(status.message(), "session_id: reaped");
  EXPECT_TRUE(IsSessionLost(status));
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

TEST(RunReportTest, MeansAreOverEpisodesAndDecisions) {
  const nlohmann::json json = RunToJson({Record(10.0, 10, 1000), Record(30.0, 30, 6000)});
  EXPECT_EQ(json["episodes"][0]["return"], 10.0);
  EXPECT_EQ(json["episodes"][0]["steps"], 10);
  EXPECT_EQ(json["episodes"][0]["spikes_per_decision"], 100.0);
  EXPECT_EQ(json["episodes"][1]["spikes_per_decision"], 200.0);
  EXPECT_EQ(json["mean_return"], 20.0);
  EXPECT_EQ(json["spikes_per_decision"], 175.0);
  EXPECT_DOUBLE_EQ(json["energy_joules_per_decision"], 5e-12 * 175.0);
  EXPECT_EQ(json["p50_seconds"], 0.002);
  EXPECT_EQ(json["p99_seconds"], 0.002);
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
