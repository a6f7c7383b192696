// Tools that know nothing of the server find its services.
#include "grpc_standard/reflection.grpc.pb.h"
#include "tests/integration/server_fixture.h"

namespace spikeserve {
namespace {

class ReflectionTest : public ServerTest {};

TEST_F(ReflectionTest, ServicesAreListed) {
  const auto stub = grpc::reflection::v1alpha::ServerReflection::NewStub(client_->channel());
  auto context = NewContext();
  const auto stream = stub->ServerReflectionInfo(context.get());
  grpc::reflection::v1alpha::ServerReflectionRequest request;
  request.set_list_services("");
  grpc::reflection::v1alpha::ServerReflectionResponse response;
  ASSERT_TRUE(stream->Write(request) && stream->Read(&response));
  std::vector<std::string> names;
  for (const auto& service : response.list_services_response().service()) {
    names.push_back(service.name());
  }
  EXPECT_THAT(names, ::testing::IsSupersetOf({"spikeserve.v1.PolicyService",
                                              "grpc.reflection.v1alpha.ServerReflection"}));
  stream->WritesDone();
  EXPECT_TRUE(stream->Finish().ok());
}

}  // namespace
}  // namespace spikeserve
