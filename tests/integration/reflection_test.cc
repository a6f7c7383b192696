// Tests that generic tools can discover the server's services, with the current version of the
// reflection protocol and with the older one.
#include "grpc/reflection/v1/reflection.grpc.pb.h"
#include "grpc_standard/reflection.grpc.pb.h"
#include "tests/integration/server_fixture.h"

namespace spikeserve {
namespace {

namespace v1alpha = grpc::reflection::v1alpha;

struct Today {
  using Service = grpc::reflection::v1::ServerReflection;
  using Request = grpc::reflection::v1::ServerReflectionRequest;
  using Response = grpc::reflection::v1::ServerReflectionResponse;
};

struct Older {
  using Service = v1alpha::ServerReflection;
  using Request = v1alpha::ServerReflectionRequest;
  using Response = v1alpha::ServerReflectionResponse;
};

// Returns the server's answer to one request.
template <typename Protocol>
typename Protocol::Response Ask(const std::shared_ptr<grpc::Channel>& channel,
                                const typename Protocol::Request& request) {
  const auto stub = Protocol::Service::NewStub(channel);
  auto context = NewContext();
  const auto stream = stub->ServerReflectionInfo(context.get());
  typename Protocol::Response response;
  EXPECT_TRUE(stream->Write(request) && stream->Read(&response));
  stream->WritesDone();
  EXPECT_TRUE(stream->Finish().ok());
  return response;
}

template <typename Protocol>
class ReflectionTest : public ServerTest {};

using Protocols = ::testing::Types<Today, Older>;
TYPED_TEST_SUITE(ReflectionTest, Protocols);

TYPED_TEST(ReflectionTest, ServicesAreListed) {
  typename TypeParam::Request request;
  request.set_list_services("");
  const auto response = Ask<TypeParam>(this->client_->channel(), request);
  std::vector<std::string> names;
  for (const auto& service : response.list_services_response().service()) {
    names.push_back(service.name());
  }
  EXPECT_THAT(names, ::testing::UnorderedElementsAre(
                         "spikeserve.v1.PolicyService", "spikeserve.v1.PolicyAdmin",
                         "inference.GRPCInferenceService", "grpc.health.v1.Health",
                         "grpc.reflection.v1.ServerReflection",
                         "grpc.reflection.v1alpha.ServerReflection"));
}

TYPED_TEST(ReflectionTest, EveryServiceIsDescribed) {
  for (const std::string service : {"spikeserve.v1.PolicyService", "spikeserve.v1.PolicyAdmin",
                                    "inference.GRPCInferenceService", "grpc.health.v1.Health"}) {
    typename TypeParam::Request request;
    request.set_file_containing_symbol(service);
    EXPECT_TRUE(Ask<TypeParam>(this->client_->channel(), request).has_file_descriptor_response())
        << service;
  }
}

class ReflectionOfTodayTest : public ServerTest {
 protected:
  grpc::reflection::v1::ServerReflectionResponse Ask(
      const grpc::reflection::v1::ServerReflectionRequest& request) {
    return spikeserve::Ask<Today>(client_->channel(), request);
  }
};

TEST_F(ReflectionOfTodayTest, AFileComesWithWhatItImports) {
  grpc::reflection::v1::ServerReflectionRequest request;
  request.set_file_by_filename("spikeserve/v1/policy_admin.proto");
  const auto response = Ask(request);
  // Itself, policy_service.proto, and descriptor.proto, whose options that one extends.
  EXPECT_EQ(response.file_descriptor_response().file_descriptor_proto_size(), 3);
  EXPECT_EQ(response.original_request().file_by_filename(), request.file_by_filename());
}

TEST_F(ReflectionOfTodayTest, AnOpenCallDoesNotKeepTheServer) {
  const auto stub = grpc::reflection::v1::ServerReflection::NewStub(client_->channel());
  auto context = NewContext();
  const auto stream = stub->ServerReflectionInfo(context.get());
  grpc::reflection::v1::ServerReflectionRequest request;
  request.set_list_services("");
  grpc::reflection::v1::ServerReflectionResponse response;
  ASSERT_TRUE(stream->Write(request) && stream->Read(&response));
  EXPECT_EQ(server_->Stop(), 0);
}

TEST_F(ReflectionOfTodayTest, WhatIsNotThereIsNotFound) {
  grpc::reflection::v1::ServerReflectionRequest request;
  request.set_file_containing_symbol("nothing.of.the.kind");
  EXPECT_EQ(Ask(request).error_response().error_code(), grpc::StatusCode::NOT_FOUND);
  request.set_file_by_filename("nothing.proto");
  EXPECT_EQ(Ask(request).error_response().error_code(), grpc::StatusCode::NOT_FOUND);
  request.mutable_file_containing_extension()->set_containing_type("spikeserve.v1.ActRequest");
  EXPECT_EQ(Ask(request).error_response().error_code(), grpc::StatusCode::NOT_FOUND);
  request.set_all_extension_numbers_of_type("nothing");
  EXPECT_EQ(Ask(request).error_response().error_code(), grpc::StatusCode::NOT_FOUND);
  request.set_all_extension_numbers_of_type("spikeserve.v1.ActRequest");
  EXPECT_EQ(Ask(request).all_extension_numbers_response().extension_number_size(), 0);
  EXPECT_EQ(Ask({}).error_response().error_code(), grpc::StatusCode::INVALID_ARGUMENT);
}

}  // namespace
}  // namespace spikeserve
