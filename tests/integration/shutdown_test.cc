// Tests of the graceful stop, and of the health status during it.
#include <chrono>

#include "core/action/action_space.h"
#include "grpc/health/v1/health.grpc.pb.h"
#include "tests/integration/http_client.h"
#include "tests/integration/server_fixture.h"

namespace spikeserve {
namespace {

using grpc::health::v1::HealthCheckResponse;

class ShutdownTest : public ServerTest {
 protected:
  std::unique_ptr<grpc::health::v1::Health::Stub> NewHealthStub() {
    return grpc::health::v1::Health::NewStub(client_->channel());
  }
};

TEST_F(ShutdownTest, AnIdleServerStops) {
  EXPECT_EQ(server_->Stop(), 0);
  EXPECT_EQ(server_->Log(), "");
}

// Requests arrive while the server stops. Each gets a complete answer or is refused with
// UNAVAILABLE.
TEST_F(ShutdownTest, CallsInFlightEnd) {
  const std::string session = client_->Open();
  auto context = NewContext();
  const auto stream = client_->stub().ActStream(context.get());
  v1::ActResponse response;
  int64_t answered = 0;
  for (int64_t step = 0; stream->Write(MakeActRequest(session, step)); ++step) {
    if (!stream->Read(&response)) break;
    ASSERT_FALSE(response.has_error()) << response.error().message();
    ASSERT_EQ(response.step(), step);
    if (++answered == 100) server_->RequestStop();
  }
  EXPECT_GE(answered, 100);
  ExpectError(stream->Finish(), grpc::StatusCode::UNAVAILABLE, "draining");
  EXPECT_EQ(server_->Wait(), 0);
  EXPECT_EQ(server_->Log(), "");
}

// A client that requests many replies and does not read them blocks its stream in the middle of a
// reply, and thereby delays the stop of the server.
class SlowReaderTest : public ShutdownTest {
 protected:
  static constexpr int kReplies = 100;
  static constexpr int kActions = 2000;  // a reply holds one float per action: 8,000 bytes
  // This many replies exceed the 64 KiB that the server may send before the client reads.
  static constexpr int kStuck = 65536 / 8000 + 1;

  void SetUp() override {
    WriteRandomPolicy(policies_.path(), "wide", 1, ActionSpace::Discrete(kActions));
    ShutdownTest::SetUp();
  }

  void Hold(const std::vector<std::string>& flags) {
    StartServer(flags);
    grpc::ChannelArguments arguments;
    arguments.SetInt(GRPC_ARG_HTTP2_BDP_PROBE, 0);  // keeps the size of the window
    arguments.SetInt(GRPC_ARG_HTTP2_STREAM_LOOKAHEAD_BYTES, 65536);
    stub_ = v1::PolicyService::NewStub(grpc::CreateCustomChannel(
        server_->grpc_address(), grpc::InsecureChannelCredentials(), arguments));
    stream_ = stub_->ActStream(context_.get());
    const v1::ActRequest request = MakeActRequest(client_->Open("wide"), 0);
    for (int i = 0; i < kReplies; ++i) ASSERT_TRUE(stream_->Write(request));
    const auto deadline = std::chrono::steady_clock::now() + std::chrono::seconds(60);
    while (Metric("spikeserve_rpc_duration_seconds_count", {"ActStream"}) < kStuck) {
      ASSERT_LT(std::chrono::steady_clock::now(), deadline) << Page("/metrics");
    }
  }

  std::unique_ptr<grpc::ClientContext> context_ = NewContext();
  std::unique_ptr<v1::PolicyService::Stub> stub_;
  std::unique_ptr<TestClient::Stream> stream_;
};

TEST_F(SlowReaderTest, TheReplyUnderWayEndsAndNewCallsAreRefused) {
  Hold({});
  const auto health = NewHealthStub();
  auto watch_context = NewContext();
  const auto watch = health->Watch(watch_context.get(), {});
  HealthCheckResponse state;
  ASSERT_TRUE(watch->Read(&state));
  server_->RequestStop();
  ASSERT_TRUE(watch->Read(&state));
  EXPECT_EQ(state.status(), HealthCheckResponse::NOT_SERVING);

  v1::OpenSessionRequest open;
  open.set_policy("box");
  ExpectError(client_->TryOpen(open), grpc::StatusCode::UNAVAILABLE, "draining");
  auto context = NewContext();
  ExpectError(client_->stub().ActStream(context.get())->Finish(), grpc::StatusCode::UNAVAILABLE,
              "draining");
  const auto page = HttpGet(server_->http_address(), "/healthz");
  ASSERT_TRUE(page.ok()) << page.status();
  EXPECT_EQ(page->code, 503);
  EXPECT_EQ(page->body, "NOT_SERVING\n");

  int replies = 0;
  v1::ActResponse response;
  while (stream_->Read(&response)) {
    ++replies;
    EXPECT_EQ(response.action_probabilities_size(), kActions);
  }
  EXPECT_GE(replies, kStuck);
  EXPECT_LT(replies, kReplies);
  ExpectError(stream_->Finish(), grpc::StatusCode::UNAVAILABLE, "draining");
  EXPECT_EQ(server_->Wait(), 0);
  EXPECT_EQ(server_->Log(), "");
}

TEST_F(SlowReaderTest, TheDrainTimeoutEndsWhatDoesNotEnd) {
  Hold({"--drain_timeout=50ms"});
  EXPECT_EQ(server_->Stop(), 0);
  EXPECT_THAT(
      server_->Log(),
      ::testing::HasSubstr("still in flight after the drain timeout drain_timeout=\"50ms\""));
}

TEST_F(ShutdownTest, AStoppedServerIsUnavailable) {
  const std::string session = client_->Open();
  EXPECT_EQ(server_->Stop(), 0);
  EXPECT_EQ(client_->TryAct(MakeActRequest(session, 0)).error_code(),
            grpc::StatusCode::UNAVAILABLE);
}

TEST_F(ShutdownTest, HealthPageSaysServing) {
  const auto reply = HttpGet(server_->http_address(), "/healthz");
  ASSERT_TRUE(reply.ok()) << reply.status();
  EXPECT_EQ(reply->code, 200);
  EXPECT_EQ(reply->body, "SERVING\n");
}

}  // namespace
}  // namespace spikeserve
