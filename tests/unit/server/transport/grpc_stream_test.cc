// Every transition of a call's request and of its answer, and what the client sees of it.
#include "server/transport/grpc_stream.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <thread>

#include "tests/unit/server/transport/connection_fixture.h"

namespace spikeserve {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;
using AnswerState = GrpcStream::AnswerState;
using RequestState = GrpcStream::RequestState;

std::string Framed(const std::string& message) {
  return std::string(4, '\0') + static_cast<char>(message.size()) + message;
}

class GrpcStreamTest : public ConnectionFixture {
 protected:
  void SendRequest(std::string data, bool is_last) {
    client_.Send(last_id_, std::move(data), is_last);
    Exchange();
  }
  // Lets the client end the call without an answer.
  void Cancel() {
    nghttp2_submit_rst_stream(client_.session(), NGHTTP2_FLAG_NONE, last_id_, NGHTTP2_CANCEL);
    Exchange();
  }
};

TEST_F(GrpcStreamTest, RequestOpenToEnded) {
  RecordingHandler& handler = OpenCall();
  SendRequest(Framed("a"), /*is_last=*/false);
  EXPECT_EQ(handler.stream()->request_state(), RequestState::kOpen);
  SendRequest(Framed("b"), /*is_last=*/true);
  EXPECT_EQ(handler.stream()->request_state(), RequestState::kEnded);
  EXPECT_THAT(handler.events(), ElementsAre("a", "b", "half close"));
}

TEST_F(GrpcStreamTest, RequestOpenToHalfClosedToEndedWhenTheHandlerPauses) {
  RecordingHandler& handler = OpenCall();
  handler.Pause();
  SendRequest(Framed("a") + Framed("b"), /*is_last=*/true);
  EXPECT_EQ(handler.stream()->request_state(), RequestState::kHalfClosed);
  EXPECT_THAT(handler.events(), ElementsAre("a"));
  handler.stream()->ResumeReading();
  EXPECT_EQ(handler.stream()->request_state(), RequestState::kHalfClosed);
  handler.stream()->ResumeReading();
  EXPECT_EQ(handler.stream()->request_state(), RequestState::kEnded);
  handler.stream()->ResumeReading();
  EXPECT_THAT(handler.events(), ElementsAre("a", "b", "half close"));
}

TEST_F(GrpcStreamTest, RequestEndedInAMessageIsRefused) {
  RecordingHandler& handler = OpenCall();
  SendRequest(Framed("abc").substr(0, 6), /*is_last=*/true);
  EXPECT_THAT(handler.events(), IsEmpty());
  EXPECT_TRUE(handler.closed_as().has_value());
  EXPECT_EQ(last_answer().headers["grpc-status"], "13");
}

TEST_F(GrpcStreamTest, AnswerNoneToSendingToWaitingAndBack) {
  RecordingHandler& handler = OpenCall();
  SendRequest("", /*is_last=*/true);
  EXPECT_EQ(handler.stream()->answer_state(), AnswerState::kNone);
  for (const char* message : {"first", "second"}) {
    handler.stream()->SendFramed(Framed(message));
    EXPECT_EQ(handler.stream()->answer_state(), AnswerState::kSending);
    Exchange();
    EXPECT_EQ(handler.stream()->answer_state(), AnswerState::kWaiting);
  }
  EXPECT_EQ(last_answer().data, Framed("first") + Framed("second"));
  EXPECT_EQ(last_answer().headers[":status"], "200");
  EXPECT_FALSE(last_answer().has_ended);
}

TEST_F(GrpcStreamTest, AnswerNoneToFinished) {
  RecordingHandler& handler = OpenCall();
  SendRequest("", /*is_last=*/true);
  handler.stream()->Finish(absl::NotFoundError("no such session"));
  EXPECT_EQ(handler.stream()->answer_state(), AnswerState::kFinished);
  handler.stream()->SendFramed(Framed("too late"));
  handler.stream()->Finish(absl::OkStatus());
  Exchange();
  EXPECT_TRUE(last_answer().has_ended);
  EXPECT_EQ(last_answer().data, "");
  EXPECT_EQ(last_answer().headers["grpc-status"], "5");
  EXPECT_EQ(handler.closed_as(), AnswerState::kClosed);
}

TEST_F(GrpcStreamTest, AnswerNoneToFinishedAfterItsDeadline) {
  RecordingHandler& handler = OpenCall({{"grpc-timeout", "2S"}});
  clock_.Advance(absl::Seconds(2));
  InTurns({[] {}});
  EXPECT_EQ(handler.stream()->answer_state(), AnswerState::kFinished);
  Exchange();
  EXPECT_EQ(last_answer().headers["grpc-status"], "4");
}

TEST_F(GrpcStreamTest, AnswerNoneToFinishedWithoutACall) {
  last_id_ = client_.Open({{"grpc-encoding", "zstd"}});
  Exchange();
  EXPECT_THAT(handlers_, IsEmpty());
  EXPECT_EQ(last_answer().headers["grpc-status"], "12");
}

TEST_F(GrpcStreamTest, AnswerNoneToFinishedOnceTheRefusedRequestIsComplete) {
  last_id_ = client_.Open({{":method", "PUT"}});
  Exchange();
  EXPECT_THAT(last_answer().headers, IsEmpty());
  SendRequest("text", /*is_last=*/true);
  EXPECT_THAT(handlers_, IsEmpty());
  EXPECT_EQ(last_answer().headers[":status"], "405");
  EXPECT_THAT(last_answer().data, HasSubstr("expected POST"));
  EXPECT_TRUE(last_answer().has_ended);
}

TEST_F(GrpcStreamTest, AnswerSendingToFinished) {
  RecordingHandler& handler = OpenCall();
  SendRequest("", /*is_last=*/true);
  handler.stream()->SendFramed(Framed("only"));
  handler.stream()->Finish(absl::OkStatus());
  EXPECT_EQ(handler.stream()->answer_state(), AnswerState::kFinished);
  Exchange();
  EXPECT_EQ(last_answer().data, Framed("only"));
  EXPECT_EQ(last_answer().headers["grpc-status"], "0");
  EXPECT_TRUE(last_answer().has_ended);
}

TEST_F(GrpcStreamTest, AnswerWaitingToFinished) {
  RecordingHandler& handler = OpenCall();
  SendRequest("", /*is_last=*/true);
  handler.stream()->SendFramed(Framed("only"));
  Exchange();
  handler.stream()->Finish(absl::AbortedError("later"));
  EXPECT_EQ(handler.stream()->answer_state(), AnswerState::kFinished);
  Exchange();
  EXPECT_EQ(last_answer().data, Framed("only"));
  EXPECT_EQ(last_answer().headers["grpc-status"], "10");
  EXPECT_TRUE(last_answer().has_ended);
}

TEST_F(GrpcStreamTest, AnswerNoneToClosed) {
  const RecordingHandler& handler = OpenCall();
  Cancel();
  EXPECT_EQ(handler.closed_as(), AnswerState::kClosed);
}

TEST_F(GrpcStreamTest, AnswerSendingToClosed) {
  RecordingHandler& handler = OpenCall();
  handler.stream()->SendFramed(Framed("lost"));
  Cancel();
  EXPECT_EQ(handler.closed_as(), AnswerState::kClosed);
}

TEST_F(GrpcStreamTest, AnswerWaitingToClosed) {
  RecordingHandler& handler = OpenCall();
  handler.stream()->SendFramed(Framed("only"));
  Exchange();
  Cancel();
  EXPECT_EQ(handler.closed_as(), AnswerState::kClosed);
}

TEST_F(GrpcStreamTest, AnswerFinishedToClosed) {
  RecordingHandler& handler = OpenCall();
  wire_.takes_bytes = false;
  handler.stream()->Finish(absl::OkStatus());
  Exchange();
  EXPECT_EQ(handler.closed_as(), AnswerState::kClosed);  // nghttp2 has the whole answer
}

TEST_F(GrpcStreamTest, TheServerResetsTheRestOfARequestThatItHasAnswered) {
  RecordingHandler& handler = OpenCall();
  EXPECT_EQ(handler.stream()->request_state(), RequestState::kOpen);
  handler.stream()->Finish(absl::OkStatus());
  Exchange();
  EXPECT_TRUE(last_answer().has_ended);
  EXPECT_EQ(nghttp2_session_find_stream(client_.session(), last_id_), nullptr);
}

using BrokenGrpcStreamTest = GrpcStreamTest;

TEST_F(BrokenGrpcStreamTest, IsStartedTwice) {
  RecordingHandler& handler = OpenCall();
  EXPECT_DEATH(handler.stream()->StartCall(), "grpc_stream.cc.*handler_ == nullptr");
}

TEST_F(BrokenGrpcStreamTest, IsDestroyedBeforeItIsClosed) {
  const auto destroy = [&] { GrpcStream stream(connection_.get(), /*session=*/nullptr, /*id=*/1); };
  EXPECT_DEATH(destroy(), "grpc_stream.cc.*kClosed");
}

TEST_F(BrokenGrpcStreamTest, IsAnsweredByAnotherThreadThanThatOfItsLoop) {
  GrpcStream* const stream = OpenCall().stream();
  const auto answer = [&] {
    InTurns({[&] { std::thread([&] { stream->Finish(absl::OkStatus()); }).join(); }});
  };
  EXPECT_DEATH(answer(), "thread_checker.h.*IsCurrent");
}

}  // namespace
}  // namespace spikeserve
