// grpc.reflection.v1: describes the services and their messages to tools such as grpcurl.
//
// Debian's gRPC implements only v1alpha, which older tools use. Newer tools try v1 first, and some
// support only v1. Thread-safe: reads the descriptors that are linked into the program.
#ifndef SERVER_RPC_REFLECTION_SERVICE_H_
#define SERVER_RPC_REFLECTION_SERVICE_H_

#include <string>
#include <utility>
#include <vector>

#include "grpc/reflection/v1/reflection.grpc.pb.h"

namespace spikeserve {

class ReflectionService final : public grpc::reflection::v1::ServerReflection::CallbackService {
 public:
  // `services` are the full names of the served services.
  explicit ReflectionService(std::vector<std::string> services) : services_(std::move(services)) {}

  grpc::ServerBidiReactor<grpc::reflection::v1::ServerReflectionRequest,
                          grpc::reflection::v1::ServerReflectionResponse>*
  ServerReflectionInfo(grpc::CallbackServerContext* context) override;

 private:
  const std::vector<std::string> services_;
};

}  // namespace spikeserve

#endif  // SERVER_RPC_REFLECTION_SERVICE_H_
