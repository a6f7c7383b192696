// A test that runs the client programs against a real server with a random policy for each
// environment.
#ifndef TESTS_INTEGRATION_CLIENT_FIXTURE_H_
#define TESTS_INTEGRATION_CLIENT_FIXTURE_H_

#include <string>
#include <vector>

#include "nlohmann/json.hpp"
#include "tests/integration/server_fixture.h"
#include "tests/integration/subprocess.h"

namespace spikeserve {

// "CartPole-v1" and so on; the policy served for each has its id as a name, in lower case.
inline constexpr const char* kEnvironments[] = {"CartPole-v1", "MountainCar-v0", "Acrobot-v1",
                                                "Pendulum-v1"};

class ClientProgramTest : public ServerTest {
 protected:
  void SetUp() override;

  // Run a program to its end, with --server first among its flags.
  Finished Spikectl(const std::string& command, const std::vector<std::string>& flags = {});
  Finished Spikeload(const std::vector<std::string>& flags);

  // The object a program printed. Fails the test where it failed or printed something else.
  static nlohmann::json ParseOutput(const Finished& finished);

  // Expects a failure with exactly one line on standard error, which contains `message`, and
  // nothing on standard output.
  static void ExpectOneLineError(const Finished& finished, const std::string& message);

 private:
  Finished Run(std::vector<std::string> arguments, const std::vector<std::string>& flags);
};

}  // namespace spikeserve

#endif  // TESTS_INTEGRATION_CLIENT_FIXTURE_H_
