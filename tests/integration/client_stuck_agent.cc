// An agent that plays the first steps of an episode with synthetic observations and then hangs
// until it is killed.
//
//   client_stuck_agent SERVER POLICY STEPS
//
// Prints one line per step, with the request and the answer in hexadecimal, and finally "stuck".
#include <unistd.h>

#include <cmath>
#include <iostream>
#include <string>
#include <vector>

#include "absl/strings/escaping.h"
#include "spikeserve/client.h"
#include "spikeserve/remote_session.h"

int main(int argc, char** argv) {
  if (argc != 4) return 1;
  const auto client = spikeserve::Client::Connect(argv[1]);
  if (!client.ok()) return 1;
  spikeserve::v1::OpenSessionRequest request;
  request.set_policy(argv[2]);
  const auto opened = (*client)->OpenSession(request);
  if (!opened.ok()) return 1;
  spikeserve::RemoteSession session(client->get(), opened->session_id(), 0);
  std::vector<float> observation(opened->observation_size());
  for (int step = 0; step < std::stoi(argv[3]); ++step) {
    for (size_t i = 0; i < observation.size(); ++i) {
      observation[i] = static_cast<float>(std::sin(0.7 * step + static_cast<double>(i)));
    }
    const double reward = 0.5 * step;
    const auto sent = session.MakeRequest(observation, reward);
    const auto answer = session.Act(observation, reward);
    if (!answer.ok()) return 1;
    std::cout << absl::BytesToHexString(sent.SerializeAsString()) << " "
              << absl::BytesToHexString(answer->SerializeAsString()) << std::endl;
  }
  std::cout << "stuck" << std::endl;
  while (true) pause();
}
