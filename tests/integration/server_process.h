// A real spikeserve process on free ports, for integration tests.
//
// Not thread-safe; each test owns its server.
#ifndef TESTS_INTEGRATION_SERVER_PROCESS_H_
#define TESTS_INTEGRATION_SERVER_PROCESS_H_

#include <memory>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "tests/integration/subprocess.h"

namespace spikeserve {

class ServerProcess {
 public:
  // Serves the policies in `policies` on free ports, with more flags if given, and returns once
  // both ports are known. INTERNAL carries the exit code and standard error of a server that ended
  // instead.
  static absl::StatusOr<std::unique_ptr<ServerProcess>> Start(
      const std::string& policies, const std::vector<std::string>& flags = {});

  const std::string& grpc_address() const { return grpc_address_; }  // HOST:PORT
  const std::string& http_address() const { return http_address_; }  // HOST:PORT

  // Asks for a graceful stop (SIGTERM) and returns at once.
  void RequestStop();

  // Waits for the end and returns the exit code.
  int Wait() { return process_->Wait(); }

  // RequestStop() and Wait().
  int Stop();

  // Everything the server logged so far.
  std::string Log() const { return process_->Errors(); }

 private:
  ServerProcess() = default;

  std::unique_ptr<Subprocess> process_;
  std::string grpc_address_;
  std::string http_address_;
};

}  // namespace spikeserve

#endif  // TESTS_INTEGRATION_SERVER_PROCESS_H_
