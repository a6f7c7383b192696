// Tests of the limits of streams: too long a request, and answers that nobody reads.
#include "tests/integration/server_fixture.h"

namespace spikeserve {
namespace {

class StreamTest : public ServerTest {};

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

}  // namespace
}  // namespace spikeserve
