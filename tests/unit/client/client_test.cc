#include "spikeserve/client.h"

#include "absl/synchronization/notification.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "spikeserve/status.h"
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
  options.retry.max_attempts = 0;
  EXPECT_TRUE(absl::IsInvalidArgument(Client::Create("localhost:1", options).status()));
}

TEST_F(ClientTest, AnUnreachableServerIsUnavailable) {
  const auto client =
      Client::Connect("unix:/nonexistent/spikeserve.socket", {}, absl::Milliseconds(1));
  EXPECT_TRUE(absl::IsUnavailable(client.status()));
  EXPECT_THAT(client.status().message(), HasSubstr("/nonexistent/spikeserve.socket"));
}

TEST_F(ClientTest, RepeatsCallsThatChangeNothing) {
  fake_.RefuseNext(2, kBusy);
  const auto policies = client_->ListPolicies();
  ASSERT_TRUE(policies.ok()) << policies.status();
  EXPECT_EQ(policies->policies(0).name(), "fake");
  EXPECT_EQ(fake_.calls(), 3);
}

TEST_F(ClientTest, KeepsTheServersMessageWhenGivingUp) {
  fake_.RefuseNext(100, kBusy);
  EXPECT_EQ(client_->ListPolicies().status(), absl::UnavailableError("draining"));
  EXPECT_EQ(fake_.calls(), 3);
}

TEST_F(ClientTest, ALostAnswerIsFetchedAgainNotDecidedAgain) {
  const std::string id = OpenSession();
  fake_.LoseNextReplies(2);
  const auto answer = client_->Act(Request(id, 0));
  ASSERT_TRUE(answer.ok()) << answer.status();
  EXPECT_EQ(fake_.decisions(), 1);
  EXPECT_EQ(client_->Act(Request(id, 0))->SerializeAsString(), answer->SerializeAsString());
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

TEST_F(ClientTest, ALostBatchIsNotDecidedAgain) {
  const std::string id = OpenSession();
  fake_.LoseNextReplies(1);
  ASSERT_TRUE(client_->ActBatch({Request(id, 0)}).ok());
  EXPECT_EQ(fake_.decisions(), 1);
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

}  // namespace
}  // namespace spikeserve
