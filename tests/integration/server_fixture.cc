#include "tests/integration/server_fixture.h"

#include <cmath>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "core/action/action_space.h"
#include "core/model/policy.h"
#include "core/model/policy_file.h"
#include "core/quantize/quantize_integer.h"
#include "tests/integration/http_client.h"
#include "tests/support/small_config.h"

namespace spikeserve {
void WriteRandomPolicy(const std::filesystem::path& directory, const std::string& name, int version,
                       const ActionSpace& action_space) {
  Policy policy = RandomPolicy(SmallConfig(), kObservationSize, action_space,
                               /*seed=*/static_cast<uint64_t>(version));
  policy.environment = "Test-v0";
  policy.target_return = 25.0f;
  policy.training = R"({"evaluation": {"mean_return": 12.5}})";
  const auto folder = directory / name / std::to_string(version);
  std::filesystem::create_directories(folder);
  const auto status = WritePolicyFile(policy, (folder / "policy.safetensors").string());
  ASSERT_TRUE(status.ok()) << status;
}

void WriteIntegerVersion(const std::filesystem::path& directory, const std::string& name,
                         int version) {
  const auto path = [&](int of) {
    return directory / name / std::to_string(of) / "policy.safetensors";
  };
  const auto policy = ReadPolicyFile(path(version));
  ASSERT_TRUE(policy.ok()) << policy.status();
  const auto integer = QuantizeToInteger(*policy);
  ASSERT_TRUE(integer.ok()) << integer.status();
  std::filesystem::create_directories(path(version + 1).parent_path());
  const auto status = WritePolicyFile(*integer, path(version + 1));
  ASSERT_TRUE(status.ok()) << status;
}

std::unique_ptr<grpc::ClientContext> NewContext() {
  auto context = std::make_unique<grpc::ClientContext>();
  context->set_deadline(std::chrono::system_clock::now() + std::chrono::seconds(60));
  return context;
}

v1::ActRequest MakeActRequest(const std::string& session, int64_t step) {
  v1::ActRequest request;
  request.set_session_id(session);
  request.set_step(step);
  request.set_reward(step == 0 ? 0.0 : 0.1 * static_cast<double>(step % 3));
  for (int i = 0; i < kObservationSize; ++i) {
    request.add_observation(static_cast<float>(std::sin(0.7 * static_cast<double>(step) + i)));
  }
  return request;
}

void ExpectError(const grpc::Status& status, grpc::StatusCode code, const std::string& message) {
  EXPECT_EQ(status.error_code(), code) << status.error_message();
  EXPECT_THAT(status.error_message(), ::testing::HasSubstr(message));
}

TestClient::TestClient(const std::string& address) {
  grpc::ChannelArguments arguments;
  arguments.SetInt(GRPC_ARG_USE_LOCAL_SUBCHANNEL_POOL, 1);  // does not share a connection
  channel_ = grpc::CreateCustomChannel(address, grpc::InsecureChannelCredentials(), arguments);
  stub_ = v1::PolicyService::NewStub(channel_);
}

std::string TestClient::Open(const std::string& policy) {
  v1::OpenSessionRequest request;
  request.set_policy(policy);
  v1::OpenSessionResponse response;
  const auto status = stub_->OpenSession(NewContext().get(), request, &response);
  EXPECT_TRUE(status.ok()) << status.error_message();
  return response.session_id();
}

v1::ActResponse TestClient::Act(const std::string& session, int64_t step) {
  v1::ActResponse response;
  const auto status = stub_->Act(NewContext().get(), MakeActRequest(session, step), &response);
  EXPECT_TRUE(status.ok()) << status.error_message();
  return response;
}

v1::EndEpisodeResponse TestClient::EndEpisode(const std::string& session, double reward) {
  v1::EndEpisodeRequest request;
  request.set_session_id(session);
  request.set_reward(reward);
  request.set_terminated(true);
  v1::EndEpisodeResponse response;
  const auto status = stub_->EndEpisode(NewContext().get(), request, &response);
  EXPECT_TRUE(status.ok()) << status.error_message();
  return response;
}

grpc::Status TestClient::TryOpen(const v1::OpenSessionRequest& request) {
  v1::OpenSessionResponse response;
  return stub_->OpenSession(NewContext().get(), request, &response);
}

grpc::Status TestClient::TryAct(const v1::ActRequest& request) {
  v1::ActResponse response;
  return stub_->Act(NewContext().get(), request, &response);
}

grpc::Status TestClient::TryEndEpisode(const v1::EndEpisodeRequest& request) {
  v1::EndEpisodeResponse response;
  return stub_->EndEpisode(NewContext().get(), request, &response);
}

void ServerTest::SetUp() {
  WriteRandomPolicy(policies_.path(), "discrete", 1, ActionSpace::Discrete(2));
  WriteRandomPolicy(policies_.path(), "discrete", 2, ActionSpace::Discrete(2));
  WriteRandomPolicy(policies_.path(), "box", 1, ActionSpace::Box({-2.0f}, {2.0f}));
  StartServer();
}

void ServerTest::StartServer(const std::vector<std::string>& flags) {
  server_.reset();
  auto server = ServerProcess::Start(policies_.path().string(), flags);
  ASSERT_TRUE(server.ok()) << server.status();
  server_ = *std::move(server);
  client_ = std::make_unique<TestClient>(server_->grpc_address());
}

std::string ServerTest::Page(const std::string& path) {
  const auto reply = HttpGet(server_->http_address(), path);
  EXPECT_TRUE(reply.ok()) << reply.status();
  return reply.ok() ? reply->body : "";
}

double ServerTest::Metric(const std::string& name, const std::vector<std::string>& labels) {
  double sum = 0.0;
  const std::string page = Page("/metrics");
  for (const absl::string_view line : absl::StrSplit(page, '\n')) {
    const size_t name_end = line.find_first_of("{ ");
    bool matches = line.substr(0, name_end) == name;
    for (const std::string& label : labels) {
      matches = matches && line.find(label) != absl::string_view::npos;
    }
    double value = 0.0;
    if (matches && absl::SimpleAtod(line.substr(line.rfind(' ') + 1), &value)) sum += value;
  }
  return sum;
}

}  // namespace spikeserve
