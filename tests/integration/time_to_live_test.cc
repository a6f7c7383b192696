// Tests that idle sessions are closed.
#include <chrono>

#include "tests/integration/server_fixture.h"

namespace spikeserve {
namespace {

class TimeToLiveTest : public ServerTest {};

TEST_F(TimeToLiveTest, AnIdleSessionIsReaped) {
  StartServer({"--session_ttl=100ms"});
  const std::string session = client_->Open();
  const auto deadline = std::chrono::steady_clock::now() + std::chrono::seconds(60);
  while (Metric("spikeserve_sessions_reaped_total", {"reason=\"idle\""}) < 1.0) {
    ASSERT_LT(std::chrono::steady_clock::now(), deadline) << Page("/metrics");
  }
  ExpectError(client_->TryAct(MakeActRequest(session, 0)), grpc::StatusCode::NOT_FOUND, session);
  EXPECT_EQ(Metric("spikeserve_sessions"), 0.0);
}

TEST_F(TimeToLiveTest, SessionsWithinTheirTimeStay) {
  StartServer({"--session_ttl=1h"});
  const std::string session = client_->Open();
  client_->Act(session, 0);
  EXPECT_EQ(Metric("spikeserve_sessions", {"policy=\"discrete\"", "version=\"2\""}), 1.0);
  EXPECT_EQ(Metric("spikeserve_sessions_reaped_total"), 0.0);
}

}  // namespace
}  // namespace spikeserve
