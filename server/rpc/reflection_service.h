// grpc.reflection.v1: tells tools which services there are and what their messages look like.
//
// Debian's gRPC has v1alpha alone, which older tools ask for; today's ask for v1 first, and some
// for nothing else. Thread-safe: it reads what was linked.
#ifndef SERVER_RPC_REFLECTION_SERVICE_H_
#define SERVER_RPC_REFLECTION_SERVICE_H_

#include <string>
#include <utility>
#include <vector>

#include "grpc/reflection/v1/reflection.grpc.pb.h"

namespace spikeserve {

class ReflectionService final : public grpc::reflection::v1::ServerReflection::CallbackService {
 public:
  // `services` are the full names of those that are served.
  explicit ReflectionService(std::vector<std::string> services) : services_(std::move(services)) {}

  grpc::ServerBidiReactor<grpc::reflection::v1::ServerReflectionRequest,
                          grpc::reflection::v1::ServerReflectionResponse>*
  ServerReflectionInfo(grpc::CallbackServerContext* context) override;

 private:
  const std::vector<std::string> services_;
};

}  // namespace spikeserve

#endif  // SERVER_RPC_REFLECTION_SERVICE_H_
