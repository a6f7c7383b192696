// Tests of episodes that are recorded by a real server and replayed on another one.
#include <csignal>

#include "core/dataset/recordings.h"
#include "tests/integration/client_fixture.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

class RecordingTest : public ClientProgramTest {
 protected:
  void SetUp() override {
    ClientProgramTest::SetUp();
    StartServer({"--record_dir=" + recordings_.path().string()});
  }

  // Stops the server, which writes all pending episodes, and returns the episodes on disk.
  std::vector<Dataset> EndServerAndRead() {
    EXPECT_EQ(server_->Stop(), 0);
    StartServer();
    const auto read = ReadRecordings(recordings_.path().string());
    EXPECT_TRUE(read.ok()) << read.status();
    return read.ok() ? *read : std::vector<Dataset>();
  }

  // Returns the path of the only recording.
  std::string Recording() const {
    for (const auto& entry : std::filesystem::directory_iterator(recordings_.path())) {
      return entry.path().string();
    }
    ADD_FAILURE() << "nothing was recorded";
    return "";
  }

  void Record(const std::string& environment, const std::string& episodes) {
    const Finished run =
        Spikectl("run", {"--env=" + environment, "--episodes=" + episodes, "--record", "--seed=3"});
    ASSERT_EQ(run.exit_code, 0) << run.errors;
    EXPECT_THAT(run.errors, HasSubstr("recorded as"));
  }

  std::string OpenRecorded(const std::string& policy) {
    v1::OpenSessionRequest request;
    request.set_policy(policy);
    request.set_record(true);
    v1::OpenSessionResponse response;
    const auto status = client_->stub().OpenSession(NewContext().get(), request, &response);
    EXPECT_TRUE(status.ok()) << status.error_message();
    EXPECT_THAT(response.recording(), HasSubstr(policy));
    return response.session_id();
  }

  // Records episodes of an environment and replays them on another server. Returns the policy
  // version that played, or 0 after a failure.
  int64_t ExpectReplay(const std::string& environment) {
    Record(environment, "3");
    const auto episodes = EndServerAndRead();
    EXPECT_EQ(episodes.size(), 3u);
    if (episodes.size() != 3) return 0;
    int64_t decisions = 0;
    for (const Dataset& dataset : episodes) {
      EXPECT_EQ(dataset.environment, environment);
      EXPECT_TRUE(dataset.episodes[0].terminated || dataset.episodes[0].truncated);
      decisions += dataset.episodes[0].steps();
    }
    const auto replay = ParseOutput(Spikectl("replay", {"--recording=" + Recording(), "--json"}));
    EXPECT_EQ(replay["identical"], true) << replay;
    EXPECT_EQ(replay["episodes"], 3);
    EXPECT_EQ(replay["decisions"], decisions);
    std::filesystem::remove_all(Recording());
    StartServer({"--record_dir=" + recordings_.path().string()});
    return episodes[0].episodes[0].served->version;
  }

  TemporaryDirectory recordings_;
};

TEST_F(RecordingTest, AReplayIsTheSameBitForBit) {
  for (const std::string environment : {"CartPole-v1", "Pendulum-v1"}) ExpectReplay(environment);
}

TEST_F(RecordingTest, AReplayOfAnIntegerPolicyIsTheSameBitForBit) {
  for (const std::string policy : {"cartpole-v1", "pendulum-v1"}) {
    WriteIntegerVersion(policies_.path(), policy, 1);
  }
  StartServer({"--record_dir=" + recordings_.path().string()});
  for (const std::string environment : {"CartPole-v1", "Pendulum-v1"}) {
    EXPECT_EQ(ExpectReplay(environment), 2) << "the version in integers";
  }
}

TEST_F(RecordingTest, AReplayFindsTheFirstDifference) {
  Record("CartPole-v1", "2");
  auto episodes = EndServerAndRead();
  ASSERT_EQ(episodes.size(), 2u);
  const std::string second = RecordingPath(
      recordings_.path().string(), std::filesystem::path(Recording()).filename().string(), 1);
  episodes[1].episodes[0].served->probabilities[3] += 1e-7f;  // the second action of step 1
  ASSERT_TRUE(WriteDataset(episodes[1], second).ok());

  const Finished replay = Spikectl("replay", {"--recording=" + Recording(), "--json"});
  EXPECT_NE(replay.exit_code, 0);
  EXPECT_THAT(replay.errors, HasSubstr("differs at episode 1, step 1"));
  const auto json = nlohmann::json::parse(replay.output, nullptr, /*allow_exceptions=*/false);
  EXPECT_EQ(json["identical"], false) << replay.output;
  EXPECT_EQ(json["difference"]["field"], "action_probabilities");
  EXPECT_EQ(json["decisions"], episodes[0].episodes[0].steps() + 1);

  const Finished alone = Spikectl("replay", {"--recording=" + second});
  ExpectOneLineError(alone, "differs at episode 1, step 1");
}

TEST_F(RecordingTest, AnotherPolicyCanBeAsked) {
  Record("CartPole-v1", "1");
  EndServerAndRead();
  ExpectOneLineError(Spikectl("replay", {"--recording=" + Recording(), "--policy=mountaincar-v0"}),
                     "observation: expected 2 numbers, received 4");
  ExpectOneLineError(Spikectl("replay", {"--recording=" + Recording(), "--version=9"}),
                     "received 9");
  ExpectOneLineError(Spikectl("replay"), "--recording: expected a directory or a file");
}

TEST_F(RecordingTest, WhatIsCutOffIsKept) {
  const std::string closed = OpenRecorded("cartpole-v1");
  const std::string stopped = OpenRecorded("cartpole-v1");
  for (int64_t step = 0; step < 5; ++step) {
    client_->Act(closed, step);
    client_->Act(stopped, step);
  }
  v1::CloseSessionRequest close;
  close.set_session_id(closed);
  v1::CloseSessionResponse response;
  ASSERT_TRUE(client_->stub().CloseSession(NewContext().get(), close, &response).ok());
  const auto episodes = EndServerAndRead();
  ASSERT_EQ(episodes.size(), 2u);
  for (const Dataset& dataset : episodes) {
    EXPECT_EQ(dataset.episodes[0].steps(), 4);
    EXPECT_TRUE(dataset.episodes[0].truncated);
  }
}

TEST_F(RecordingTest, SessionsThatDoNotAskLeaveNothing) {
  const Finished run = Spikectl("run", {"--env=CartPole-v1"});
  ASSERT_EQ(run.exit_code, 0) << run.errors;
  const std::string session = OpenRecorded("cartpole-v1");
  client_->Act(session, 0);
  client_->EndEpisode(session, 1.0);
  const auto episodes = EndServerAndRead();
  ASSERT_EQ(episodes.size(), 1u);
  EXPECT_EQ(episodes[0].episodes[0].steps(), 1);
}

TEST_F(RecordingTest, EpisodesAreCounted) {
  const std::string session = OpenRecorded("cartpole-v1");
  client_->Act(session, 0);
  client_->EndEpisode(session, 1.0);
  const auto deadline = std::chrono::steady_clock::now() + std::chrono::seconds(60);
  while (Metric("spikeserve_recorded_episodes_total", {"outcome=\"written\""}) < 1.0) {
    ASSERT_LT(std::chrono::steady_clock::now(), deadline) << Page("/metrics");
  }
  EXPECT_EQ(Metric("spikeserve_recorded_episodes_total"), 1.0);
}

TEST_F(RecordingTest, WithoutADirectoryNothingIsRecorded) {
  StartServer();
  v1::OpenSessionRequest request;
  request.set_policy("cartpole-v1");
  request.set_record(true);
  ExpectError(client_->TryOpen(request), grpc::StatusCode::FAILED_PRECONDITION, "--record_dir");
}

}  // namespace
}  // namespace spikeserve
