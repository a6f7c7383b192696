// Tests of the loops of spikeload, without running the program.
#include <fstream>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "loadtest/caller.h"
#include "loadtest/load_options.h"
#include "loadtest/load_report.h"
#include "loadtest/recorded_episode.h"
#include "tests/support/fake_policy_service.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

constexpr int kAgents = 5;
constexpr int kEpisodeSteps = 3;

class CallerTest : public ::testing::TestWithParam<LoadMode> {
 protected:
  CallerTest() {
    ClientOptions options;
    options.retry.max_attempts = 1;
    client_ = *Client::Create(fake_.channel(), options);
  }

  Caller MakeCaller() { return MakeCaller(client_->options().retry); }
  Caller MakeCaller(const RetryOptions& retry) {
    std::vector<SimulatedAgent> agents;
    for (int i = 0; i < kAgents; ++i) {
      RemoteSession session(client_.get(), client_->OpenSession({})->session_id(), 0);
      agents.emplace_back(session, /*observation_size=*/4, /*first_episode_steps=*/1 + i % 3,
                          kEpisodeSteps, /*seed=*/i);
    }
    return Caller(MakeExchange(GetParam(), /*batch_size=*/2, client_.get()), std::move(agents),
                  retry,
                  /*pause_after_error=*/absl::Milliseconds(1), /*patience=*/absl::Seconds(20));
  }

  FakePolicyService fake_;
  std::unique_ptr<Client> client_;
};

TEST_P(CallerTest, EveryAgentPlaysOn) {
  Caller caller = MakeCaller();
  const LoadReport report = caller.RunClosedLoop(std::chrono::milliseconds(200));
  EXPECT_EQ(report.errors, 0) << report.first_error;
  EXPECT_GE(report.decisions, kAgents);
  EXPECT_EQ(report.decisions, fake_.decisions());
  EXPECT_EQ(report.latency.count(), report.decisions);
  EXPECT_GT(report.seconds, 0.0);
  EXPECT_TRUE(caller.CloseSessions().ok());
  EXPECT_EQ(fake_.sessions(), 0);
}

TEST_P(CallerTest, RequestsFollowTheSchedule) {
  Caller caller = MakeCaller();
  const LoadReport report = caller.RunAtRate(
      {.offset = std::chrono::milliseconds(1), .interval = std::chrono::milliseconds(2)},
      std::chrono::milliseconds(200));
  EXPECT_EQ(report.errors, 0) << report.first_error;
  // The requests are due at 1, 3, 5 and so on up to 199 ms, and all are sent, even if late.
  EXPECT_EQ(report.decisions, 100);
  EXPECT_EQ(report.latency.count(), 100);
}

TEST_P(CallerTest, AServerTooSlowForTheScheduleIsChargedForTheWait) {
  Caller caller = MakeCaller();
  // 100,000 requests a second are more than the fake server can answer. The last one is still due
  // at 20 ms, and its latency is measured from then.
  const LoadReport report = caller.RunAtRate(
      {.offset = std::chrono::nanoseconds(0), .interval = std::chrono::microseconds(10)},
      std::chrono::milliseconds(20));
  EXPECT_EQ(report.decisions, 2000);
  EXPECT_GT(report.latency.Quantile(1.0), (report.seconds - 0.02) / 2);
}

TEST_P(CallerTest, ALastingErrorRetiresItsAgent) {
  Caller caller = MakeCaller();
  for (int i = 0; i < kAgents; ++i) {
    ASSERT_TRUE(client_->CloseSession("session-" + std::to_string(i)).ok());
  }
  // The call would not end if an agent continued.
  const LoadReport report = caller.RunClosedLoop(std::chrono::hours(24));
  EXPECT_EQ(report.errors, kAgents);
  EXPECT_EQ(report.decisions, 0);
  EXPECT_TRUE(absl::IsNotFound(report.first_error));
}

std::string ModeName(const ::testing::TestParamInfo<LoadMode>& test) {
  switch (test.param) {
    case LoadMode::kUnary:
      return "unary";
    case LoadMode::kStream:
      return "stream";
    case LoadMode::kBatch:
      break;
  }
  return "batch";
}

INSTANTIATE_TEST_SUITE_P(Modes, CallerTest,
                         ::testing::Values(LoadMode::kUnary, LoadMode::kStream, LoadMode::kBatch),
                         ModeName);

using CallTest = CallerTest;

TEST_P(CallTest, AFailureIsCountedAfterTheLastTry) {
  RetryOptions retry;
  retry.max_attempts = 2;
  retry.initial_backoff = absl::Milliseconds(1);
  Caller caller = MakeCaller(retry);
  fake_.RefuseNext(2 * kAgents, {grpc::StatusCode::UNAVAILABLE, "overloaded"});
  const LoadReport report = caller.RunClosedLoop(std::chrono::milliseconds(200));
  EXPECT_GE(report.errors, 1);
  EXPECT_GE(report.decisions, 1);
}

TEST_P(CallTest, ALimitThatWasReachedRetiresNobody) {
  Caller caller = MakeCaller();
  fake_.RefuseNext(kAgents, {grpc::StatusCode::RESOURCE_EXHAUSTED, "decisions_per_second"});
  const LoadReport report = caller.RunClosedLoop(std::chrono::milliseconds(200));
  EXPECT_GE(report.errors, kAgents);
  EXPECT_GE(report.decisions, 1);
}

INSTANTIATE_TEST_SUITE_P(Modes, CallTest, ::testing::Values(LoadMode::kUnary, LoadMode::kBatch),
                         ModeName);

TEST(SimulatedAgentTest, ObservationsAreSeededAndWithinBounds) {
  static constexpr float kBound = 0.25f;
  const auto observations = [](uint64_t seed) {
    SimulatedAgent agent(RemoteSession(nullptr, "s", 0), 1000, 9, 9, seed, kBound);
    const auto& values = agent.request().observation();
    for (const float value : values) {
      EXPECT_GE(value, -kBound);
      EXPECT_LE(value, kBound);
    }
    return std::vector<float>(values.begin(), values.end());
  };
  EXPECT_EQ(observations(3), observations(3));
  EXPECT_NE(observations(3), observations(4));
}

TEST(SimulatedAgentTest, ARecordedEpisodeIsSentAsItIsAndThenAgain) {
  const std::string path = testing::TempDir() + "/episode.csv";
  std::ofstream(path) << "0,0.5,-1\n-1,0.25,2e-3\n";
  const auto recorded = ReadRecordedEpisode(path);
  ASSERT_TRUE(recorded.ok()) << recorded.status();
  SimulatedAgent agent(RemoteSession(nullptr, "s", 0), &*recorded, 9, 9);
  const auto expect_request = [&agent](double reward, std::vector<float> observation) {
    EXPECT_EQ(agent.request().reward(), reward);
    EXPECT_THAT(agent.request().observation(), testing::ElementsAreArray(observation));
    v1::ActResponse answer;
    answer.set_session_id("s");
    answer.set_step(agent.request().step());
    ASSERT_TRUE(agent.Accept(answer).ok());
  };
  expect_request(0.0, {0.5f, -1.0f});
  expect_request(-1.0, {0.25f, 2e-3f});
  expect_request(0.0, {0.5f, -1.0f});
}

TEST(LoadReportTest, MergeAddsCallersThatRanSideBySide) {
  LoadReport first, second;
  first.decisions = 30;
  first.seconds = 2.0;
  first.latency.Add(0.01);
  first.longest.Add(0.02);
  second.decisions = 10;
  second.seconds = 1.0;
  second.latency.Add(0.01);
  second.longest.Add(0.02);
  second.CountError(absl::UnavailableError("first"));
  second.CountError(absl::NotFoundError("second"));
  LoadReport sum;
  sum.Merge(first);
  sum.Merge(second);
  EXPECT_EQ(sum.first_error, absl::UnavailableError("first"));
  const nlohmann::json json = sum.ToJson();
  EXPECT_EQ(json.size(), 7u);
  EXPECT_EQ(json["decisions"], 40);
  EXPECT_EQ(json["decisions_per_second"], 20.0);
  EXPECT_EQ(json["p50_seconds"], 0.01);
  EXPECT_EQ(json["p99_seconds"], 0.01);
  EXPECT_EQ(json["longest_wait_p50_seconds"], 0.02);
  EXPECT_EQ(json["longest_wait_p99_seconds"], 0.02);
  EXPECT_EQ(json["errors"], 2);
  EXPECT_THAT(sum.ToText(), HasSubstr("40 decisions in 2.0 s, 20.0 decisions/s"));
}

}  // namespace
}  // namespace spikeserve
