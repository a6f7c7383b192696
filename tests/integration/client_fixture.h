// A fixture that runs the client programs against a real server, which serves a random policy for
// each environment.
#ifndef TESTS_INTEGRATION_CLIENT_FIXTURE_H_
#define TESTS_INTEGRATION_CLIENT_FIXTURE_H_

#include <string>
#include <vector>

#include "nlohmann/json.hpp"
#include "tests/integration/server_fixture.h"
#include "tests/integration/subprocess.h"

namespace spikeserve {

// The environments' ids. The name of each one's policy is its id in lower case.
inline constexpr const char* kEnvironments[] = {"CartPole-v1", "MountainCar-v0", "Acrobot-v1",
                                                "Pendulum-v1"};

class ClientProgramTest : public ServerTest {
 protected:
  void SetUp() override;

  // Run the program until it exits, with --server before `flags`.
  Finished Spikectl(const std::string& command, const std::vector<std::string>& flags = {});
  Finished Spikeload(const std::vector<std::string>& flags);

  // Returns the JSON object that a program printed. Fails the test if the program failed or printed
  // anything else.
  static nlohmann::json ParseOutput(const Finished& finished);

  // Expects that the program failed with exactly one line on standard error, which contains
  // `message`, and no standard output.
  static void ExpectOneLineError(const Finished& finished, const std::string& message);

 private:
  Finished Run(std::vector<std::string> arguments, const std::vector<std::string>& flags);
};

}  // namespace spikeserve

#endif  // TESTS_INTEGRATION_CLIENT_FIXTURE_H_
