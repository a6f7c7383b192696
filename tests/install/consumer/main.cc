// Opens a session on the server named on the command line, asks for one action and prints it.
#include <iostream>
#include <vector>

#include "spikeserve/client.h"
#include "spikeserve/remote_session.h"

int main(int argc, char** argv) {
  if (argc != 2) return 2;
  const auto client = spikeserve::Client::Connect(argv[1]);
  if (!client.ok()) {
    std::cerr << client.status() << std::endl;
    return 1;
  }
  spikeserve::v1::OpenSessionRequest request;
  request.set_policy("cartpole");
  auto session = spikeserve::RemoteSession::Open(client->get(), request);
  if (!session.ok()) {
    std::cerr << session.status() << std::endl;
    return 1;
  }
  const std::vector<float> observation = {0.0f, 0.0f, 0.1f, 0.0f};
  const auto answer = session->Act(observation, /*reward=*/0.0);
  if (!answer.ok()) {
    std::cerr << answer.status() << std::endl;
    return 1;
  }
  std::cout << "action " << answer->action().discrete() << std::endl;
  return session->Close().ok() ? 0 : 1;
}
