// A graceful stop, and health on the way there.
#include "grpc_standard/health.grpc.pb.h"
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

TEST_F(ShutdownTest, HealthIsServedForTheWholeAndForTheService) {
  const auto health = NewHealthStub();
  grpc::health::v1::HealthCheckRequest request;
  HealthCheckResponse response;
  for (const std::string service : {"", "spikeserve.v1.PolicyService"}) {
    request.set_service(service);
    ASSERT_TRUE(health->Check(NewContext().get(), request, &response).ok()) << service;
    EXPECT_EQ(response.status(), HealthCheckResponse::SERVING) << service;
  }
  request.set_service("spikeserve.v1.Nothing");
  EXPECT_EQ(health->Check(NewContext().get(), request, &response).error_code(),
            grpc::StatusCode::NOT_FOUND);
}

TEST_F(ShutdownTest, WatchersSeeTheServerStop) {
  const auto health = NewHealthStub();
  auto context = NewContext();
  const auto watch = health->Watch(context.get(), {});
  HealthCheckResponse response;
  ASSERT_TRUE(watch->Read(&response));
  EXPECT_EQ(response.status(), HealthCheckResponse::SERVING);
  server_->RequestStop();
  ASSERT_TRUE(watch->Read(&response));
  EXPECT_EQ(response.status(), HealthCheckResponse::NOT_SERVING);
  v1::OpenSessionRequest open;
  open.set_policy("box");
  EXPECT_EQ(client_->TryOpen(open).error_code(), grpc::StatusCode::UNAVAILABLE);
  context->TryCancel();
  EXPECT_EQ(server_->Wait(), 0);
}

TEST_F(ShutdownTest, AnIdleServerStops) {
  EXPECT_EQ(server_->Stop(), 0);
  EXPECT_EQ(server_->Log(), "");
}

TEST_F(ShutdownTest, OpenStreamsAreToldAndTheServerEnds) {
  const std::string session = client_->Open();
  auto context = NewContext();
  const auto stream = client_->stub().ActStream(context.get());
  v1::ActResponse response;
  ASSERT_TRUE(stream->Write(MakeActRequest(session, 0)) && stream->Read(&response));
  server_->RequestStop();
  EXPECT_FALSE(stream->Read(&response));
  ExpectError(stream->Finish(), grpc::StatusCode::UNAVAILABLE, "draining");
  EXPECT_EQ(server_->Wait(), 0);
}

// Requests pour in while the server stops: each is answered in full or refused with UNAVAILABLE,
// and none is cut off.
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
