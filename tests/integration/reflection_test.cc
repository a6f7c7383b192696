// Tools that know nothing of the server find its services.
#include "grpc_standard/reflection.grpc.pb.h"
#include "tests/integration/server_fixture.h"

namespace spikeserve {
namespace {

namespace v1alpha = grpc::reflection::v1alpha;

class ReflectionTest : public ServerTest {
 protected:
  // The server's answer to one question.
  v1alpha::ServerReflectionResponse Ask(const v1alpha::ServerReflectionRequest& request) {
    const auto stub = v1alpha::ServerReflection::NewStub(client_->channel());
    auto context = NewContext();
    const auto stream = stub->ServerReflectionInfo(context.get());
    v1alpha::ServerReflectionResponse response;
    EXPECT_TRUE(stream->Write(request) && stream->Read(&response));
    stream->WritesDone();
    EXPECT_TRUE(stream->Finish().ok());
    return response;
  }
};

TEST_F(ReflectionTest, ServicesAreListed) {
  v1alpha::ServerReflectionRequest request;
  request.set_list_services("");
  const auto response = Ask(request);
  std::vector<std::string> names;
  for (const auto& service : response.list_services_response().service()) {
    names.push_back(service.name());
  }
  EXPECT_THAT(names, ::testing::IsSupersetOf(
                         {"spikeserve.v1.PolicyService", "inference.GRPCInferenceService",
                          "grpc.health.v1.Health", "grpc.reflection.v1alpha.ServerReflection"}));
}

TEST_F(ReflectionTest, EveryServiceIsDescribed) {
  for (const std::string service :
       {"spikeserve.v1.PolicyService", "inference.GRPCInferenceService", "grpc.health.v1.Health"}) {
    v1alpha::ServerReflectionRequest request;
    request.set_file_containing_symbol(service);
    EXPECT_TRUE(Ask(request).has_file_descriptor_response()) << service;
  }
}

}  // namespace
}  // namespace spikeserve
