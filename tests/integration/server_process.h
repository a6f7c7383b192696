// A real spikeserve process on free ports, for integration tests.
//
// Not thread-safe.
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
  // Starts a server of the policies in directory `policies`, with additional `flags`, and waits
  // until both ports are known. Returns INTERNAL, with the exit code and standard error, if the
  // server exits instead.
  static absl::StatusOr<std::unique_ptr<ServerProcess>> Start(
      const std::string& policies, const std::vector<std::string>& flags = {});

  const std::string& grpc_address() const { return grpc_address_; }  // HOST:PORT
  const std::string& http_address() const { return http_address_; }  // HOST:PORT

  // Requests a graceful stop (SIGTERM) without waiting for it.
  void RequestStop();

  // Waits for the process to exit and returns its exit code.
  int Wait() { return process_->Wait(); }

  // Calls RequestStop() and Wait().
  int Stop();

  // Returns everything that the server has logged so far.
  std::string Log() const { return process_->Errors(); }

 private:
  ServerProcess() = default;

  std::unique_ptr<Subprocess> process_;
  std::string grpc_address_;
  std::string http_address_;
};

}  // namespace spikeserve

#endif  // TESTS_INTEGRATION_SERVER_PROCESS_H_
