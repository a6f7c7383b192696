#include "core/agent/episode_recorder.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>

#include "core/agent/agent_session.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;

class EpisodeRecorderTest : public ::testing::Test {
 protected:
  std::unique_ptr<AgentSession> Open(SessionOptions options = SmallOptions()) {
    auto agent =
        std::make_unique<AgentSession>(served_, NewSession("id", std::move(options)), &clock_);
    auto recorder = std::make_shared<EpisodeRecorder>(served_, [this](Dataset dataset) {
      recorded_.push_back(std::move(dataset));
      return std::make_shared<const std::atomic<RecordingState>>(RecordingState::kStored);
    });
    recorder_ = recorder.get();
    agent->AddListener(std::move(recorder));
    return agent;
  }

  // Plays steps 0 to `steps` - 1, requests each of them twice, and returns the answers.
  static std::vector<Answer> Play(AgentSession& agent, int64_t steps) {
    std::vector<Answer> answers;
    for (int64_t t = 0; t < steps; ++t) {
      for (int attempt = 0; attempt < 2; ++attempt) {
        const auto answer = agent.Act(t, ObservationAt(t), RewardAt(t));
        EXPECT_TRUE(answer.ok()) << answer.status();
        if (attempt == 0) answers.push_back(**answer);
      }
    }
    return answers;
  }

  const std::shared_ptr<const ServedPolicy> served_ =
      Serve(SmallConfig(), ActionSpace::Discrete(2));
  FakeClock clock_;
  std::vector<Dataset> recorded_;
  const EpisodeRecorder* recorder_ = nullptr;  // of the last agent
};

TEST_F(EpisodeRecorderTest, AnEpisodeIsWhatWasAskedAndAnswered) {
  SessionOptions options = SmallOptions();
  options.action_selection = {.sample = true, .temperature = 0.5f};
  options.labels = {{"robot", "7"}};
  const auto agent = Open(options);
  const auto answers = Play(*agent, 3);
  ASSERT_TRUE(agent
                  ->EndEpisode({.reward = 5.0,
                                .terminated = true,
                                .target_return = 20.0,
                                .observation = {7.0f, 8.0f, 9.0f}})
                  .ok());
  ASSERT_EQ(recorded_.size(), 1u);
  EXPECT_TRUE(CheckEpisode(recorded_[0], recorded_[0].episodes[0]).ok());
  const Episode& episode = recorded_[0].episodes[0];
  std::vector<float> observations;
  for (int64_t t = 0; t < 3; ++t) {
    for (const float x : ObservationAt(t)) observations.push_back(x);
  }
  observations.insert(observations.end(), {7.0f, 8.0f, 9.0f});
  EXPECT_EQ(episode.observations, observations);
  EXPECT_THAT(episode.rewards, ElementsAre(RewardAt(1), RewardAt(2), 5.0));
  EXPECT_TRUE(episode.terminated);
  EXPECT_FALSE(episode.truncated);
  ASSERT_EQ(episode.steps(), 3);
  for (int t = 0; t < 3; ++t) {
    EXPECT_EQ(episode.actions[t], answers[t].action);
    EXPECT_EQ(episode.served->returns_to_go[t], answers[t].return_to_go);
    EXPECT_EQ(episode.served->spikes[t], answers[t].counts.total_spikes());
    EXPECT_EQ(episode.served->probabilities[2 * t + 1], answers[t].probabilities[1]);
  }
  EXPECT_EQ(episode.served->policy, "small");
  EXPECT_EQ(episode.served->version, 1);
  EXPECT_EQ(episode.served->seed, 42u);
  EXPECT_EQ(episode.served->target_return, 10.0);
  EXPECT_EQ(episode.served->temperature, 0.5f);
  EXPECT_EQ(episode.served->labels, options.labels);

  Play(*agent, 1);
  ASSERT_TRUE(agent->EndEpisode({}).ok());
  ASSERT_EQ(recorded_.size(), 2u);
  EXPECT_EQ(recorded_[1].episodes[0].served->episode, 1);
  EXPECT_EQ(recorded_[1].episodes[0].served->target_return, 20.0);
}

TEST_F(EpisodeRecorderTest, TheStateIsThatOfTheLastEpisodeThatEnded) {
  const auto agent = Open();
  EXPECT_EQ(recorder_->last_state(), RecordingState::kNotRecorded);
  Play(*agent, 2);
  ASSERT_TRUE(agent->EndEpisode({.reward = 1.0}).ok());
  EXPECT_EQ(recorder_->last_state(), RecordingState::kStored);
  Play(*agent, 1);
  EXPECT_EQ(recorder_->last_state(), RecordingState::kNotRecorded);
}

TEST_F(EpisodeRecorderTest, BothTheExecutedAndTheAnsweredActionsAreKept) {
  auto agent = Open();
  std::vector<Action> answered;
  for (int64_t t = 0; t < 4; ++t) {
    const int64_t other = t == 0 ? 0 : 1 - answered.back().discrete;
    auto executed = t == 2 ? std::optional<ReportedAction>(other) : std::nullopt;
    if (t == 2) executed->source = {.kind = 2, .operator_id = "anna"};
    const auto answer = agent->Act(t, ObservationAt(t), RewardAt(t), executed);
    ASSERT_TRUE(answer.ok()) << answer.status();
    answered.push_back((*answer)->action);
  }
  agent.reset();  // cuts off the action of step 3
  const Episode& episode = recorded_.at(0).episodes[0];
  EXPECT_TRUE(CheckEpisode(recorded_[0], episode).ok());
  answered.pop_back();
  EXPECT_EQ(episode.served->answered_actions, answered);
  std::vector<Action> executed = answered;
  executed[1].discrete = 1 - executed[1].discrete;
  EXPECT_EQ(episode.actions, executed);
  const std::vector<StepSource> sources = {{}, {SourceKind::kOperator, "anna"}, {}};
  EXPECT_EQ(episode.served->sources, sources);

  const std::string path = ::testing::TempDir() + "/executed_actions_test.cbor";
  ASSERT_TRUE(WriteDataset(recorded_[0], path).ok());
  const auto read = ReadDataset(path);
  ASSERT_TRUE(read.ok()) << read.status();
  EXPECT_EQ(read->episodes[0].served->answered_actions, answered);
  EXPECT_EQ(read->episodes[0].actions, executed);
  EXPECT_EQ(read->episodes[0].served->sources, sources);
}

TEST_F(EpisodeRecorderTest, AnUnknownLastObservationIsNoNumber) {
  const auto agent = Open();
  Play(*agent, 2);
  ASSERT_TRUE(agent->EndEpisode({.reward = 1.0}).ok());
  const Episode& episode = recorded_.at(0).episodes[0];
  ASSERT_EQ(episode.observations.size(), 9u);
  for (size_t i = 0; i < 9; ++i) EXPECT_EQ(std::isnan(episode.observations[i]), i >= 6) << i;
  EXPECT_TRUE(episode.truncated);
}

TEST_F(EpisodeRecorderTest, WhatIsCutOffEndsBeforeTheActionNobodyRewarded) {
  auto agent = Open();
  Play(*agent, 3);
  agent.reset();
  ASSERT_EQ(recorded_.size(), 1u);
  const Episode& episode = recorded_[0].episodes[0];
  EXPECT_TRUE(CheckEpisode(recorded_[0], episode).ok());
  EXPECT_EQ(episode.steps(), 2);
  EXPECT_EQ(episode.observations.size(), 9u);
  EXPECT_EQ(episode.observations[6], ObservationAt(2)[0]);
  EXPECT_TRUE(episode.truncated);
  EXPECT_FALSE(episode.terminated);
}

TEST_F(EpisodeRecorderTest, ASessionWithoutAWholeStepLeavesNothing) {
  Play(*Open(), 1);
  Open();
  EXPECT_TRUE(recorded_.empty());
}

TEST_F(EpisodeRecorderTest, AWrongLastObservationChangesNothing) {
  const auto agent = Open();
  Play(*agent, 2);
  const auto ended = agent->EndEpisode({.reward = 1.0, .observation = {1.0f}});
  EXPECT_EQ(ended.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(agent->session().step, 2);
  EXPECT_TRUE(recorded_.empty());
}

TEST_F(EpisodeRecorderTest, EpisodesSurviveTheirFile) {
  const auto agent = Open();
  Play(*agent, 4);
  ASSERT_TRUE(agent->EndEpisode({.reward = 0.1}).ok());
  const std::string path = ::testing::TempDir() + "/episode_recorder_test.cbor";
  ASSERT_TRUE(WriteDataset(recorded_.at(0), path).ok());
  const auto read = ReadDataset(path);
  ASSERT_TRUE(read.ok()) << read.status();
  const ServedEpisode& before = *recorded_[0].episodes[0].served;
  const ServedEpisode& after = *read->episodes.at(0).served;
  EXPECT_EQ(after.probabilities, before.probabilities);
  EXPECT_EQ(after.returns_to_go, before.returns_to_go);
  EXPECT_EQ(after.spikes, before.spikes);
  EXPECT_EQ(after.temperature, std::nullopt);
  EXPECT_EQ(read->episodes[0].rewards, recorded_[0].episodes[0].rewards);
  EXPECT_TRUE(std::isnan(read->episodes[0].observations.back()));
}

}  // namespace
}  // namespace spikeserve
