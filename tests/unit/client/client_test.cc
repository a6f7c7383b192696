#include "spikeserve/client.h"

#include "absl/synchronization/notification.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "spikeserve/status.h"
#include "spikeserve/unacknowledged.h"
#include "tests/support/fake_policy_service.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

class ClientTest : public ::testing::Test {
 protected:
  ClientTest() {
    ClientOptions options;
    options.retry.max_attempts = 3;
    options.retry.sleep = [](absl::Duration) {};
    client_ = *Client::Create(fake_.channel(), options);
  }

  std::string OpenSession() { return client_->OpenSession({})->session_id(); }

  static v1::ActRequest Request(const std::string& session_id, int64_t step) {
    v1::ActRequest request;
    request.set_session_id(session_id);
    request.set_step(step);
    return request;
  }

  FakePolicyService fake_;
  std::unique_ptr<Client> client_;
};

const grpc::Status kBusy(grpc::StatusCode::UNAVAILABLE, "draining");

TEST_F(ClientTest, RefusesInvalidOptions) {
  ClientOptions options;
  options.call_timeout = absl::ZeroDuration();
  const auto client = Client::Create(fake_.channel(), options);
  EXPECT_TRUE(absl::IsInvalidArgument(client.status()));
  EXPECT_THAT(client.status().message(), HasSubstr("call_timeout"));
  options = ClientOptions();
  options.security.keepalive = absl::ZeroDuration();
  EXPECT_EQ(options.Validate().message(), "keepalive: expected more than 0, received 0");
  options = ClientOptions();
  options.security.token = "a token\n";
  EXPECT_EQ(Client::Create("localhost:1", options).status().message(),
            "token: expected printable ASCII characters, received others");
  options = ClientOptions();
  options.retry.max_attempts = 0;
  EXPECT_TRUE(absl::IsInvalidArgument(Client::Create("localhost:1", options).status()));
}

TEST_F(ClientTest, AnUnreachableServerIsUnavailable) {
  const auto client =
      Client::Connect("unix:/nonexistent/spikeserve.socket", {}, absl::Milliseconds(1));
  EXPECT_TRUE(absl::IsUnavailable(client.status()));
  EXPECT_THAT(client.status().message(), HasSubstr("/nonexistent/spikeserve.socket"));
}

TEST_F(ClientTest, KeepsTheServersMessageWhenGivingUp) {
  fake_.RefuseNext(100, kBusy);
  EXPECT_EQ(client_->ListPolicies().status(), absl::UnavailableError("draining"));
  EXPECT_EQ(fake_.calls(), 3);
}

TEST_F(ClientTest, EveryAttemptHasADeadline) {
  ClientOptions options;
  options.call_timeout = absl::Milliseconds(100);
  options.retry.max_attempts = 1;
  const auto hasty = *Client::Create(fake_.channel(), options);
  const std::string id = OpenSession();
  fake_.HangNext();
  EXPECT_TRUE(absl::IsDeadlineExceeded(hasty->Act(Request(id, 0)).status()));
  // The next attempt is answered.
  EXPECT_TRUE(client_->Act(Request(id, 0)).ok());
}

TEST_F(ClientTest, ErrorsOfTheRequestAreNotRepeated) {
  const std::string id = OpenSession();
  const int before = fake_.calls();
  EXPECT_EQ(client_->Act(Request(id, 7)).status(),
            absl::FailedPreconditionError("step: expected 0, received 7"));
  const absl::Status lost = client_->GetSession("nobody").status();
  EXPECT_TRUE(absl::IsNotFound(lost) && IsSessionLost(lost)) << lost;
  EXPECT_EQ(lost.message(), "session_id: no session \"nobody\"");
  EXPECT_EQ(fake_.calls(), before + 2);
}

TEST_F(ClientTest, ActAsyncAnswersOnce) {
  const std::string id = OpenSession();
  absl::Notification answered;
  absl::StatusOr<v1::ActResponse> answer;
  client_->ActAsync(Request(id, 0), [&](absl::StatusOr<v1::ActResponse> response) {
    answer = std::move(response);
    answered.Notify();
  });
  answered.WaitForNotification();
  ASSERT_TRUE(answer.ok()) << answer.status();
  EXPECT_EQ(answer->SerializeAsString(), client_->Act(Request(id, 0))->SerializeAsString());
}

TEST_F(ClientTest, ABadItemDoesNotFailItsBatch) {
  const std::string first = OpenSession();
  const std::string second = OpenSession();
  const auto results =
      client_->ActBatch({Request(first, 0), Request("nobody", 0), Request(second, 0)});
  ASSERT_TRUE(results.ok()) << results.status();
  ASSERT_EQ(results->size(), 3u);
  EXPECT_EQ((*results)[0]->session_id(), first);
  EXPECT_EQ((*results)[1].status(),
            ForSession(absl::NotFoundError("session_id: no session \"nobody\"")));
  EXPECT_EQ((*results)[2]->session_id(), second);
}

TEST_F(ClientTest, ALostEndCountsOnceAndIsAnsweredAgain) {
  const std::string id = OpenSession();
  ASSERT_TRUE(client_->Act(Request(id, 0)).ok());
  fake_.LoseNextReplies(2);
  v1::EndEpisodeRequest request;
  request.set_session_id(id);
  const auto ended = client_->EndEpisode(request);
  ASSERT_TRUE(ended.ok()) << ended.status();
  EXPECT_EQ(ended->steps(), 1);
  EXPECT_EQ(client_->GetSession(id)->episode(), 1);
}

TEST_F(ClientTest, ClosingTwiceBecauseOfALostReplyIsOk) {
  const std::string id = OpenSession();
  fake_.LoseNextReplies(1);
  EXPECT_TRUE(client_->CloseSession(id).ok());
  EXPECT_EQ(fake_.sessions(), 0);
  EXPECT_TRUE(absl::IsNotFound(client_->CloseSession(id)));
}

TEST(StatusTest, UnknownCodesStayErrors) {
  EXPECT_EQ(StatusFromCode(17, "new"), absl::UnknownError("status code 17: new"));
  EXPECT_EQ(StatusFromCode(-1, "odd"), absl::UnknownError("status code -1: odd"));
}

TEST(StatusTest, AResetByAProxyIsUnavailable) {
  const std::string reset = "Received RST_STREAM with error code 2";
  EXPECT_EQ(StatusFromGrpc({grpc::StatusCode::INTERNAL, reset}), absl::UnavailableError(reset));
  EXPECT_TRUE(absl::IsInternal(StatusFromGrpc({grpc::StatusCode::INTERNAL, "a bug"})));
}

TEST(StatusTest, KeepsTheExpectedDecision) {
  const absl::Status status = StatusFromCode(9, "decision: expected 7, received 9", {}, 7);
  EXPECT_EQ(ExpectedDecision(status), 7u);
  EXPECT_EQ(ExpectedDecision(absl::FailedPreconditionError("step")), std::nullopt);
}

TEST(StatusTest, SaysWhichAnswerDiverged) {
  const absl::Status status = DivergedError("mine", 12);
  EXPECT_TRUE(absl::IsDataLoss(status));
  EXPECT_EQ(DivergedAt(status), 12u);
  EXPECT_EQ(DivergedAt(absl::DataLossError("other")), std::nullopt);
}

v1::ActResponse Answer(uint64_t durable_decision) {
  v1::ActResponse answer;
  answer.set_durable_decision(durable_decision);
  return answer;
}

// Redis may lose what it has acknowledged.
TEST(UnacknowledgedTest, KeepsAlsoWhatTheStoreHas) {
  Unacknowledged unacknowledged;
  EXPECT_FALSE(unacknowledged.Covers(0));
  for (uint64_t i = 0; i < 12; ++i) unacknowledged.Add(i, v1::ActRequest(), Answer(i + 1));
  unacknowledged.Add(12, v1::EndEpisodeRequest(), v1::EndEpisodeResponse());
  EXPECT_EQ(unacknowledged.size(), 13u);
  EXPECT_TRUE(unacknowledged.Covers(0));
  EXPECT_TRUE(unacknowledged.Covers(12));
  EXPECT_FALSE(unacknowledged.Covers(13));
}

TEST(UnacknowledgedTest, KeepsAtMost256Decisions) {
  Unacknowledged unacknowledged;
  for (uint64_t i = 0; i < 1000; ++i) unacknowledged.Add(i, v1::ActRequest(), Answer(0));
  EXPECT_EQ(unacknowledged.size(), 256u);
}

TEST(UnacknowledgedTest, AnAnswerThatChangesIsAnErrorOnce) {
  FakePolicyService fake;
  const auto client = *Client::Create(fake.channel());
  v1::ActRequest request;
  request.set_session_id(client->OpenSession({})->session_id());
  auto answer = *client->Act(request);
  answer.mutable_stats()->set_compute_seconds(1.0);  // may differ
  Unacknowledged unacknowledged;
  unacknowledged.Add(0, request, answer);
  EXPECT_TRUE(unacknowledged.SendAgain(0, client.get(), nullptr).ok());
  answer.mutable_action()->set_discrete(1 - answer.action().discrete());
  unacknowledged.Add(0, request, answer);
  const absl::Status diverged = unacknowledged.SendLastAgain(client.get(), nullptr);
  EXPECT_EQ(DivergedAt(diverged), 0u) << diverged;
  EXPECT_TRUE(unacknowledged.SendLastAgain(client.get(), nullptr).ok());
}

}  // namespace
}  // namespace spikeserve
