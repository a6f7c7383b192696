// Every transition of a connection, and what the client sees of it.
#include "server/transport/connection.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <thread>

#include "tests/unit/server/transport/connection_fixture.h"

namespace spikeserve {
namespace {

using testing::Contains;
using testing::ElementsAre;
using testing::IsEmpty;
using State = Connection::State;

class ConnectionTest : public ConnectionFixture {
 protected:
  // Sends more frames than the limit allows.
  void Flood() {
    for (int64_t i = 0; i <= 3 * limits_.max_control_frames_per_second; ++i) {
      nghttp2_submit_ping(client_.session(), NGHTTP2_FLAG_NONE, nullptr);
    }
    Exchange();
  }
  void Leave() {
    wire_.client_left = true;
    Serve();
  }
};

TEST_F(ConnectionTest, OpenToGoingAwayWhenTheServerStops) {
  OpenCall();
  EXPECT_EQ(connection_->state(), State::kOpen);
  connection_->GoAway();
  connection_->GoAway();
  EXPECT_EQ(connection_->state(), State::kGoingAway);
  Exchange();
  EXPECT_EQ(connection_->state(), State::kGoingAway);  // the call goes on
  EXPECT_THAT(client_.goaways(), ElementsAre(NGHTTP2_NO_ERROR));
  EXPECT_FALSE(wire_.server_shut_down);
}

TEST_F(ConnectionTest, OpenToGoingAwayAfterItsLongestAge) {
  limits_.max_connection_age = absl::Hours(1);
  OpenCall();
  clock_.Advance(absl::Hours(1) + absl::Seconds(1));
  InTurns({[&] { connection_->CheckTimes(); }});
  EXPECT_EQ(connection_->state(), State::kGoingAway);
}

TEST_F(ConnectionTest, OpenToClosingWhenTheClientDoesNotCall) {
  Exchange();
  clock_.Advance(limits_.first_request_timeout + absl::Seconds(1));
  InTurns({[&] { connection_->CheckTimes(); }});
  EXPECT_EQ(connection_->state(), State::kClosing);
  Exchange();
  EXPECT_THAT(client_.goaways(), ElementsAre(NGHTTP2_NO_ERROR));
  EXPECT_TRUE(wire_.server_shut_down);
}

TEST_F(ConnectionTest, OpenToClosingWhenTheClientEndsTheSession) {
  Exchange();
  nghttp2_session_terminate_session(client_.session(), NGHTTP2_NO_ERROR);
  Exchange();
  EXPECT_EQ(connection_->state(), State::kClosing);
}

TEST_F(ConnectionTest, OpenThroughCondemnedToClosing) {
  const RecordingHandler& handler = OpenCall();
  Flood();
  EXPECT_EQ(connection_->state(), State::kClosing);
  EXPECT_THAT(client_.goaways(), ElementsAre(NGHTTP2_ENHANCE_YOUR_CALM));
  EXPECT_EQ(handler.closed_as(), GrpcStream::AnswerState::kClosed);
}

TEST_F(ConnectionTest, OpenToClosedWhenTheClientLeaves) {
  const RecordingHandler& handler = OpenCall();
  Leave();
  EXPECT_EQ(connection_->state(), State::kClosed);
  EXPECT_TRUE(handler.closed_as().has_value());
  EXPECT_THAT(client_.goaways(), IsEmpty());
}

TEST_F(ConnectionTest, OpenToClosedWhenTheClientDoesNotSpeakHttp2) {
  wire_.to_server = "GET / HTTP/1.1\r\nHost: localhost\r\n\r\n";
  Serve();
  EXPECT_EQ(connection_->state(), State::kClosed);
}

TEST_F(ConnectionTest, OpenToClosedWhenTheHandshakeTakesTooLong) {
  wire_.is_handshaking = true;
  clock_.Advance(limits_.first_request_timeout + absl::Seconds(1));
  InTurns({[&] { connection_->CheckTimes(); }});
  EXPECT_EQ(connection_->state(), State::kClosed);
  EXPECT_EQ(wire_.to_client, "");
}

TEST_F(ConnectionTest, OpenToClosedInFavourOfOthers) {
  Exchange();
  connection_->Drop();
  EXPECT_EQ(connection_->state(), State::kClosed);
  Exchange();
  EXPECT_THAT(client_.goaways(), ElementsAre(NGHTTP2_ENHANCE_YOUR_CALM));
}

TEST_F(ConnectionTest, GoingAwayToClosingAfterTheLastCall) {
  RecordingHandler& handler = OpenCall();
  connection_->GoAway();
  Exchange();
  client_.Send(last_id_, "", /*is_last=*/true);
  Exchange();
  handler.stream()->Finish(absl::OkStatus());
  Exchange();
  EXPECT_EQ(connection_->state(), State::kClosing);
  EXPECT_EQ(last_answer().headers["grpc-status"], "0");
  EXPECT_TRUE(wire_.server_shut_down);
}

TEST_F(ConnectionTest, GoingAwayThroughCondemnedToClosing) {
  OpenCall();
  connection_->GoAway();
  Flood();
  EXPECT_EQ(connection_->state(), State::kClosing);
  EXPECT_THAT(client_.goaways(), Contains(NGHTTP2_ENHANCE_YOUR_CALM));
}

TEST_F(ConnectionTest, GoingAwayToClosedWhenTheClientLeaves) {
  OpenCall();
  connection_->GoAway();
  Leave();
  EXPECT_EQ(connection_->state(), State::kClosed);
}

class ClosingConnectionTest : public ConnectionTest {
 protected:
  ClosingConnectionTest() {
    Exchange();
    nghttp2_session_terminate_session(client_.session(), NGHTTP2_NO_ERROR);
    Exchange();
    EXPECT_EQ(connection_->state(), State::kClosing);
  }
};

TEST_F(ClosingConnectionTest, StaysAndSendsNothing) {
  connection_->GoAway();
  wire_.to_server = "bytes that it drops";
  Exchange();
  EXPECT_EQ(connection_->state(), State::kClosing);
  EXPECT_THAT(client_.goaways(), IsEmpty());
}

TEST_F(ClosingConnectionTest, ToClosedWhenTheClientLeaves) {
  Leave();
  EXPECT_EQ(connection_->state(), State::kClosed);
}

TEST_F(ClosingConnectionTest, ToClosedWhenTheClientSendsTooMuch) {
  wire_.to_server = std::string(2 << 20, 'x');
  Serve();
  EXPECT_EQ(connection_->state(), State::kClosed);
}

TEST_F(ClosingConnectionTest, ToClosedInTime) {
  clock_.Advance(absl::Milliseconds(900));
  InTurns({[&] {
             connection_->CheckTimes();
             EXPECT_EQ(connection_->state(), State::kClosing);
             clock_.Advance(absl::Milliseconds(200));
           },
           [&] { connection_->CheckTimes(); }});
  EXPECT_EQ(connection_->state(), State::kClosed);
}

TEST_F(ClosingConnectionTest, ToClosedInFavourOfOthers) {
  connection_->Drop();
  EXPECT_EQ(connection_->state(), State::kClosed);
}

TEST_F(ConnectionTest, ClosedIsTheEnd) {
  Exchange();
  connection_->Close();
  nghttp2_submit_ping(client_.session(), NGHTTP2_FLAG_NONE, nullptr);
  connection_->GoAway();
  connection_->CheckTimes();
  connection_->Drain();
  connection_->Drop();
  connection_->Continue();
  Exchange();
  EXPECT_EQ(connection_->state(), State::kClosed);
  EXPECT_THAT(client_.goaways(), IsEmpty());
  EXPECT_EQ(times_closed_, 1);
}

using BrokenConnectionTest = ConnectionTest;

TEST_F(BrokenConnectionTest, IsDestroyedBeforeItIsClosed) {
  EXPECT_DEATH(connection_ = nullptr, "connection.cc.*is_closed");
}

TEST_F(BrokenConnectionTest, IsStartedTwice) {
  EXPECT_DEATH(connection_->Start().IgnoreError(), "connection.cc.*watched_ == ");
}

TEST_F(BrokenConnectionTest, IsUsedByAnotherThreadThanThatOfItsLoop) {
  const auto use = [&] { InTurns({[&] { std::thread([&] { connection_->GoAway(); }).join(); }}); };
  EXPECT_DEATH(use(), "thread_checker.h.*IsCurrent");
}

TEST_F(BrokenConnectionTest, WaitsTwiceForItsTurn) {
  shared_.unauthenticated_queue.Wait(connection_.get());
  EXPECT_DEATH(shared_.unauthenticated_queue.Wait(connection_.get()), "unauthenticated_queue.cc");
  shared_.unauthenticated_queue.Remove(connection_.get());
}

}  // namespace
}  // namespace spikeserve
