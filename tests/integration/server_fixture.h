// A fixture that makes gRPC calls to a real server process with small random policies.
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

// Writes a small random policy to `directory`/`name`/`version`. Fails the test if that is not
// possible.
void WriteRandomPolicy(const std::filesystem::path& directory, const std::string& name, int version,
                       const ActionSpace& action_space);

// Writes the policy `name`/`version` of `directory`, with 8-bit weights, as its next version. Fails
// the test if that is not possible.
void WriteIntegerVersion(const std::filesystem::path& directory, const std::string& name,
                         int version);

// Makes gRPC calls on a connection of its own, like a separate client process.
class TestClient {
 public:
  using Stream = grpc::ClientReaderWriter<v1::ActRequest, v1::ActResponse>;

  explicit TestClient(const std::string& address);

  v1::PolicyService::Stub& stub() { return *stub_; }
  const std::shared_ptr<grpc::Channel>& channel() const { return channel_; }

  // These calls fail the test if the call fails.
  std::string Open(const std::string& policy = "discrete");
  v1::ActResponse Act(const std::string& session, int64_t step);
  v1::EndEpisodeResponse EndEpisode(const std::string& session, double reward);

  // These calls return the status of the call and ignore the reply.
  grpc::Status TryOpen(const v1::OpenSessionRequest& request);
  grpc::Status TryAct(const v1::ActRequest& request);
  grpc::Status TryEndEpisode(const v1::EndEpisodeRequest& request);

 private:
  std::shared_ptr<grpc::Channel> channel_;
  std::unique_ptr<v1::PolicyService::Stub> stub_;
};

// Returns a context with a deadline of 60 s, so that a server that does not answer cannot block a
// test.
std::unique_ptr<grpc::ClientContext> NewContext();

// Returns a valid request with a synthetic observation and reward.
v1::ActRequest MakeActRequest(const std::string& session, int64_t step);

// Serves versions 1 and 2 of the policy `discrete` (two actions) and version 1 of `box` (one
// continuous action).
class ServerTest : public ::testing::Test {
 protected:
  void SetUp() override;

  // Stops the server if it is running, and starts it with additional `flags`.
  void StartServer(const std::vector<std::string>& flags = {});

  // Returns the body of an HTTP page such as "/metrics".
  std::string Page(const std::string& path);

  // Returns the sum of those samples of a metric whose line contains all of `labels`; 0 if there
  // are none.
  double Metric(const std::string& name, const std::vector<std::string>& labels = {});

  TemporaryDirectory policies_;
  std::unique_ptr<ServerProcess> server_;
  std::unique_ptr<TestClient> client_;
};

// Expects an error with this code and a message that contains `message`.
void ExpectError(const grpc::Status& status, grpc::StatusCode code, const std::string& message);

}  // namespace spikeserve

#endif  // TESTS_INTEGRATION_SERVER_FIXTURE_H_
