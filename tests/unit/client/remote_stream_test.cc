#include "spikeserve/remote_stream.h"

#include <vector>

#include "gtest/gtest.h"
#include "spikeserve/client.h"
#include "spikeserve/remote_session.h"
#include "spikeserve/status.h"
#include "tests/support/fake_policy_service.h"

namespace spikeserve {
namespace {

constexpr absl::Duration kPatience = absl::Seconds(60);

class RemoteStreamTest : public ::testing::Test {
 protected:
  RemoteSession Open() { return {client_.get(), client_->OpenSession({})->session_id(), 0}; }

  FakePolicyService fake_;
  std::unique_ptr<Client> client_ = *Client::Create(fake_.channel());
};

TEST_F(RemoteStreamTest, ABadItemDoesNotEndTheStream) {
  RemoteSession session = Open();
  const auto stream = client_->OpenStream();
  ASSERT_TRUE(stream->Send(RemoteSession(client_.get(), "nobody", 3).MakeRequest({}, 0.0)).ok());
  ASSERT_TRUE(stream->Send(session.MakeRequest({}, 0.0)).ok());

  const auto bad = stream->Receive(kPatience);
  ASSERT_TRUE(bad.ok()) << bad.status();
  EXPECT_EQ(bad->session_id, "nobody");
  EXPECT_EQ(bad->step, 3);
  EXPECT_EQ(bad->response.status(),
            ForSession(absl::NotFoundError("session_id: no session \"nobody\"")));

  const auto good = stream->Receive(kPatience);
  ASSERT_TRUE(good.ok()) << good.status();
  EXPECT_TRUE(good->response.ok());
}

TEST_F(RemoteStreamTest, WithoutARequestThereIsNoReply) {
  const auto stream = client_->OpenStream();
  EXPECT_TRUE(absl::IsDeadlineExceeded(stream->Receive(absl::Milliseconds(1)).status()));
  // The stream can still be used.
  ASSERT_TRUE(stream->Send(Open().MakeRequest({}, 0.0)).ok());
  EXPECT_TRUE(stream->Receive(kPatience).ok());
}

TEST_F(RemoteStreamTest, CloseSendLetsTheServerFinish) {
  const auto stream = client_->OpenStream();
  ASSERT_TRUE(stream->Send(Open().MakeRequest({}, 0.0)).ok());
  stream->CloseSend();
  EXPECT_FALSE(stream->Send(Open().MakeRequest({}, 0.0)).ok());
  EXPECT_TRUE(stream->Receive(kPatience).ok());
  EXPECT_TRUE(absl::IsOutOfRange(stream->Receive(kPatience).status()));
}

TEST_F(RemoteStreamTest, ABrokenStreamStaysBrokenWithoutRetries) {
  ClientOptions options;
  options.retry.max_attempts = 1;
  const auto client = *Client::Create(fake_.channel(), options);
  RemoteSession session = Open();
  fake_.BreakNextStream({grpc::StatusCode::UNAVAILABLE, "draining"});
  const auto broken = client->OpenStream();
  ASSERT_TRUE(broken->Send(session.MakeRequest({}, 0.0)).ok());
  const auto first = broken->Receive(kPatience);
  ASSERT_TRUE(first.ok()) << first.status();
  EXPECT_EQ(broken->Receive(kPatience).status(), absl::UnavailableError("draining"));
  EXPECT_EQ(broken->Send(session.MakeRequest({}, 0.0)), absl::UnavailableError("draining"));

  // The session has not accepted the answer, so it requests the same step on another stream and
  // gets the same answer.
  const auto stream = client_->OpenStream();
  ASSERT_TRUE(stream->Send(session.MakeRequest({}, 0.0)).ok());
  const auto again = stream->Receive(kPatience);
  ASSERT_TRUE(again.ok()) << again.status();
  EXPECT_EQ(again->response->SerializeAsString(), first->response->SerializeAsString());
  EXPECT_EQ(fake_.decisions(), 1);
}

TEST_F(RemoteStreamTest, AnIdleStreamThatBreaksIsOpenedByTheNextRequest) {
  RemoteSession session = Open();
  const auto stream = client_->OpenStream();
  fake_.BreakNextStream({grpc::StatusCode::UNAVAILABLE, "draining"});
  ASSERT_TRUE(stream->Send(&session, {}, 0.0).ok());
  ASSERT_TRUE(stream->Receive(kPatience).ok());
  EXPECT_EQ(stream->Receive(kPatience).status(), absl::UnavailableError("draining"));
  ASSERT_TRUE(stream->Send(&session, {}, 0.0).ok());
  const auto reply = stream->Receive(kPatience);
  ASSERT_TRUE(reply.ok()) << reply.status();
  EXPECT_TRUE(reply->response.ok()) << reply->response.status();
}

TEST_F(RemoteStreamTest, ASessionHasOneRequestUnderWay) {
  RemoteSession session = Open();
  const auto stream = client_->OpenStream();
  ASSERT_TRUE(stream->Send(&session, {}, 0.0).ok());
  EXPECT_TRUE(absl::IsInvalidArgument(stream->Send(&session, {}, 0.0)));
  EXPECT_TRUE(stream->Receive(kPatience).ok());
  EXPECT_TRUE(stream->Send(&session, {}, 0.0).ok());
}

TEST_F(RemoteStreamTest, ALostSessionIsReplacedOnRequest) {
  auto lost = RemoteSession::Open(client_.get(), {});
  auto reopened = RemoteSession::Open(client_.get(), {}, /*reopens=*/true);
  ASSERT_TRUE(lost.ok() && reopened.ok());
  const auto stream = client_->OpenStream();
  for (RemoteSession* session : {&*lost, &*reopened}) {
    ASSERT_TRUE(stream->Send(session, {}, 0.0).ok());
    ASSERT_TRUE(stream->Receive(kPatience)->response.ok());
    ASSERT_TRUE(client_->CloseSession(session->session_id()).ok());
  }
  ASSERT_TRUE(stream->Send(&*lost, {}, 1.0).ok());
  ASSERT_TRUE(stream->Send(&*reopened, {}, 1.0).ok());
  for (int i = 0; i < 2; ++i) {
    const auto reply = stream->Receive(kPatience);
    ASSERT_TRUE(reply.ok()) << reply.status();
    if (reply->session == &*lost) {
      EXPECT_TRUE(IsSessionLost(reply->response.status())) << reply->response.status();
    } else {
      EXPECT_EQ(reply->response->step(), 0);
    }
  }
  EXPECT_EQ(reopened->reopened(), 1);
}

TEST_F(RemoteStreamTest, MayBeDroppedWithRequestsUnderWay) {
  const auto stream = client_->OpenStream();
  for (int step = 0; step < 100; ++step) {
    ASSERT_TRUE(
        stream->Send(RemoteSession(client_.get(), "nobody", step).MakeRequest({}, 0.0)).ok());
  }
}

}  // namespace
}  // namespace spikeserve
