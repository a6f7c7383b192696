// A test that talks gRPC to a real server process with small random policies.
#ifndef TESTS_INTEGRATION_SERVER_FIXTURE_H_
#define TESTS_INTEGRATION_SERVER_FIXTURE_H_

#include <gmock/gmock.h>
#include <grpcpp/grpcpp.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <memory>
#include <string>
#include <vector>

#include "core/action/action_space.h"
#include "spikeserve/v1/policy_service.grpc.pb.h"
#include "tests/integration/server_process.h"
#include "tests/support/temporary_directory.h"

namespace spikeserve {

constexpr int kObservationSize = 4;  // of every policy below

// Writes a small random policy below `directory`, and fails the test where that fails.
void WriteRandomPolicy(const std::filesystem::path& directory, const std::string& name, int version,
                       const ActionSpace& action_space);

// gRPC calls on one channel of their own, as one client process would make them.
class TestClient {
 public:
  using Stream = grpc::ClientReaderWriter<v1::ActRequest, v1::ActResponse>;

  explicit TestClient(const std::string& address);

  v1::PolicyService::Stub& stub() { return *stub_; }
  const std::shared_ptr<grpc::Channel>& channel() const { return channel_; }

  // Fail the test where the call fails.
  std::string Open(const std::string& policy = "discrete");
  v1::ActResponse Act(const std::string& session, int64_t step);
  v1::EndEpisodeResponse EndEpisode(const std::string& session, double reward);

  // One call, its reply dropped.
  grpc::Status TryOpen(const v1::OpenSessionRequest& request);
  grpc::Status TryAct(const v1::ActRequest& request);
  grpc::Status TryEndEpisode(const v1::EndEpisodeRequest& request);

 private:
  std::shared_ptr<grpc::Channel> channel_;
  std::unique_ptr<v1::PolicyService::Stub> stub_;
};

// A context whose deadline keeps a broken server from hanging a test.
std::unique_ptr<grpc::ClientContext> NewContext();

// A valid request of a made-up agent.
v1::ActRequest MakeActRequest(const std::string& session, int64_t step);

// Serves `discrete` in versions 1 and 2 (two actions), and `box` (one continuous action).
class ServerTest : public ::testing::Test {
 protected:
  void SetUp() override;

  // Ends the server, if one runs, and starts it with more flags.
  void StartServer(const std::vector<std::string>& flags = {});

  // The body of a page over HTTP, such as "/metrics".
  std::string Page(const std::string& path);

  // The sum of a metric's samples whose line contains each of `labels`; 0 if there are none.
  double Metric(const std::string& name, const std::vector<std::string>& labels = {});

  TemporaryDirectory policies_;
  std::unique_ptr<ServerProcess> server_;
  std::unique_ptr<TestClient> client_;
};

// Expects a failure with this code and a message that contains `message`.
void ExpectError(const grpc::Status& status, grpc::StatusCode code, const std::string& message);

}  // namespace spikeserve

#endif  // TESTS_INTEGRATION_SERVER_FIXTURE_H_
