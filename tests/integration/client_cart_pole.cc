// Plays an episode of CartPole on the server named on the command line and prints the return.
//
//   client_cart_pole HOST:PORT SEED
//
// It needs only the client library and the environments, so that it is quick to build for another
// processor.
#include <cstdint>
#include <iostream>
#include <memory>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/numbers.h"
#include "core/environment/environment.h"
#include "spikeserve/client.h"
#include "spikeserve/remote_session.h"

namespace spikeserve {
namespace {

absl::StatusOr<double> Play(const char* server, uint64_t seed) {
  const auto client = Client::Connect(server);
  if (!client.ok()) return client.status();
  v1::OpenSessionRequest request;
  request.set_policy("cartpole");
  auto session = RemoteSession::Open(client->get(), request);
  if (!session.ok()) return session.status();
  const auto environment = *MakeEnvironment("CartPole-v1");
  StepResult result = {.observation = environment->Reset(seed)};
  double total = 0.0;
  while (!result.done()) {
    const auto answer = session->Act(result.observation, result.reward);
    if (!answer.ok()) return answer.status();
    result = environment->Step(
        {.discrete = static_cast<int>(answer->action().discrete()), .continuous = {}});
    total += result.reward;
  }
  if (const absl::Status closed = session->Close(); !closed.ok()) return closed;
  return total;
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  uint64_t seed = 0;
  if (argc != 3 || !absl::SimpleAtoi(argv[2], &seed)) {
    std::cerr << "usage: client_cart_pole HOST:PORT SEED\n";
    return 2;
  }
  const auto total = spikeserve::Play(argv[1], seed);
  if (!total.ok()) {
    std::cerr << total.status() << "\n";
    return 1;
  }
  std::cout << "return " << *total << "\n";
  return 0;
}
