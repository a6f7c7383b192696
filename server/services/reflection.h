// Describes the services to clients that do not have their .proto files.
//
// Source: gRPC's server reflection protocol, version 1. Version 1alpha has the same messages.
#pragma once

#include <string>
#include <vector>

#include "grpc/reflection/v1/reflection.pb.h"
#include "server/transport/call.h"

namespace spikeserve {

// Answers one request with what the program's descriptors say; `services` are the names to list.
// Thread-safe.
void AnswerReflection(const grpc::reflection::v1::ServerReflectionRequest& request,
                      const std::vector<std::string>& services,
                      grpc::reflection::v1::ServerReflectionResponse* response);

// Answers the requests of one call, in order. Any caller may make it. Confined to the thread of the
// call's loop.
class ReflectionCall final : public CallHandler {
 public:
  // `services` must outlive the call.
  ReflectionCall(Call* call, const std::vector<std::string>* services)
      : call_(call), services_(*services) {}

  size_t message_limit() const override { return 64 << 10; }  // requests are names
  void OnMessage(absl::string_view message) override;
  void OnTooLong(size_t length) override;
  void OnHalfClose() override;
  void OnClosed() override { call_ = nullptr; }
  void OnDrain() override;

 private:
  Call* call_;
  const std::vector<std::string>& services_;
};

}  // namespace spikeserve
