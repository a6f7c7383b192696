// Tests of many sessions on one stream or in one batch. An invalid item does not affect the others.
#include <map>

#include "tests/integration/server_fixture.h"

namespace spikeserve {
namespace {

class StreamTest : public ServerTest {};

// Returns the bytes of an answer without its session id and its measured time, which differ between
// equal sessions.
std::string Comparable(v1::ActResponse response) {
  response.clear_session_id();
  response.mutable_stats()->clear_compute_seconds();
  return response.SerializeAsString();
}

TEST_F(StreamTest, SessionsShareAStream) {
  constexpr int kSessions = 10;
  constexpr int64_t kSteps = 12;
  const std::string alone = client_->Open();
  std::vector<std::string> expected;
  for (int64_t step = 0; step < kSteps; ++step) {
    expected.push_back(Comparable(client_->Act(alone, step)));
  }

  std::vector<std::string> sessions;
  for (int i = 0; i < kSessions; ++i) sessions.push_back(client_->Open());
  auto context = NewContext();
  const auto stream = client_->stub().ActStream(context.get());
  for (int64_t step = 0; step < kSteps; ++step) {
    for (const std::string& session : sessions) {
      ASSERT_TRUE(stream->Write(MakeActRequest(session, step)));
    }
  }
  ASSERT_TRUE(stream->WritesDone());
  std::map<std::string, int64_t> next_step;
  v1::ActResponse response;
  while (stream->Read(&response)) {
    const int64_t step = next_step[response.session_id()]++;
    ASSERT_EQ(response.step(), step);
    EXPECT_EQ(Comparable(response), expected[static_cast<size_t>(step)]);
  }
  EXPECT_TRUE(stream->Finish().ok());
  for (const std::string& session : sessions) EXPECT_EQ(next_step[session], kSteps);
}

TEST_F(StreamTest, AFailingRequestIsAnsweredAndTheStreamGoesOn) {
  const std::string session = client_->Open();
  auto context = NewContext();
  const auto stream = client_->stub().ActStream(context.get());
  const auto ask = [&](const v1::ActRequest& request) {
    v1::ActResponse response;
    EXPECT_TRUE(stream->Write(request) && stream->Read(&response));
    return response;
  };
  EXPECT_FALSE(ask(MakeActRequest(session, 0)).has_error());

  const v1::ActResponse out_of_order = ask(MakeActRequest(session, 7));
  EXPECT_EQ(out_of_order.session_id(), session);
  EXPECT_EQ(out_of_order.step(), 7);
  EXPECT_EQ(out_of_order.error().code(), grpc::StatusCode::FAILED_PRECONDITION);
  EXPECT_EQ(out_of_order.error().message(), "step: expected 1, received 7");
  EXPECT_FALSE(out_of_order.has_action() || out_of_order.has_stats());

  const v1::ActResponse unknown = ask(MakeActRequest("nobody", 0));
  EXPECT_EQ(unknown.error().code(), grpc::StatusCode::NOT_FOUND);

  const v1::ActResponse next = ask(MakeActRequest(session, 1));
  EXPECT_FALSE(next.has_error());
  EXPECT_EQ(next.step(), 1);
  stream->WritesDone();
  EXPECT_TRUE(stream->Finish().ok());
}

TEST_F(StreamTest, TooLongARequestIsAnsweredAndTheStreamGoesOn) {
  StartServer({"--max_message_bytes=1000"});
  const std::string session = client_->Open();
  auto context = NewContext();
  const auto stream = client_->stub().ActStream(context.get());
  v1::ActResponse response;
  ASSERT_TRUE(stream->Write(MakeActRequest(std::string(1000, 'x'), 0)) && stream->Read(&response));
  EXPECT_EQ(response.error().code(), grpc::StatusCode::RESOURCE_EXHAUSTED);
  EXPECT_THAT(response.error().message(),
              testing::StartsWith("--max_message_bytes: expected at most 1000, received 10"));
  ASSERT_TRUE(stream->Write(MakeActRequest(session, 0)) && stream->Read(&response));
  EXPECT_FALSE(response.has_error());
  stream->WritesDone();
  EXPECT_TRUE(stream->Finish().ok());
}

// The answers of one round exceed what the server stores for one connection that does not read.
TEST_F(StreamTest, AnswersThatWereReadMakeRoomForOthers) {
  constexpr int kStreams = 90;
  constexpr int kActions = 4000;  // an answer holds one float per action: 16,000 bytes
  WriteRandomPolicy(policies_.path(), "wide", 1, ActionSpace::Discrete(kActions));
  StartServer();
  std::vector<std::string> sessions;
  std::vector<std::unique_ptr<grpc::ClientContext>> contexts;
  std::vector<std::unique_ptr<TestClient::Stream>> streams;
  for (int i = 0; i < kStreams; ++i) {
    sessions.push_back(client_->Open("wide"));
    contexts.push_back(NewContext());
    streams.push_back(client_->stub().ActStream(contexts.back().get()));
  }
  for (int64_t step = 0; step < 3; ++step) {
    for (int i = 0; i < kStreams; ++i) {
      v1::ActResponse response;
      ASSERT_TRUE(streams[i]->Write(MakeActRequest(sessions[i], step)));
      ASSERT_TRUE(streams[i]->Read(&response)) << "stream " << i << ", step " << step;
      EXPECT_EQ(response.step(), step);
    }
  }
  for (const auto& stream : streams) {
    EXPECT_TRUE(stream->WritesDone());
    EXPECT_TRUE(stream->Finish().ok());
  }
}

TEST_F(StreamTest, ABatchAnswersItemByItem) {
  const std::string first = client_->Open("discrete");
  const std::string second = client_->Open("box");
  v1::ActBatchRequest batch;
  *batch.add_requests() = MakeActRequest(first, 0);
  *batch.add_requests() = MakeActRequest("nobody", 0);
  *batch.add_requests() = MakeActRequest(second, 0);
  *batch.add_requests() = MakeActRequest(second, 5);
  *batch.add_requests() = MakeActRequest(first, 1);
  batch.mutable_requests(2)->mutable_observation()->Truncate(2);
  v1::ActBatchResponse response;
  ASSERT_TRUE(client_->stub().ActBatch(NewContext().get(), batch, &response).ok());
  ASSERT_EQ(response.results_size(), 5);
  const auto& results = response.results();
  EXPECT_EQ(results[0].code(), grpc::StatusCode::OK);
  EXPECT_EQ(results[0].response().session_id(), first);
  EXPECT_EQ(results[1].code(), grpc::StatusCode::NOT_FOUND);
  EXPECT_FALSE(results[1].has_response());
  EXPECT_EQ(results[2].code(), grpc::StatusCode::INVALID_ARGUMENT);
  EXPECT_EQ(results[2].message(), "observation: expected 4 numbers, received 2");
  EXPECT_EQ(results[3].code(), grpc::StatusCode::FAILED_PRECONDITION);
  EXPECT_EQ(results[3].message(), "step: expected 0, received 5");
  EXPECT_EQ(results[4].code(), grpc::StatusCode::OK);
  EXPECT_EQ(results[4].response().step(), 1);
  EXPECT_FALSE(client_->Act(second, 0).has_error());
}

}  // namespace
}  // namespace spikeserve
