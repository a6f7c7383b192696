// Balances a pole with the decisions of a server.
//
// usage: call [HOST:PORT]
//
// docs/start/cpp.md installs the C++ client; then
//   g++ -std=c++20 examples/call.cc -o call $(pkg-config --cflags --libs spikeserve)
#include <cmath>
#include <cstdint>
#include <iostream>
#include <vector>

#include "spikeserve/client.h"
#include "spikeserve/remote_session.h"

namespace {

// Moves Gymnasium's CartPole by one step of 20 ms: {position, velocity, angle, angular velocity}.
std::vector<float> Step(const std::vector<float>& s, int64_t action) {
  const float sine = std::sin(s[2]), cosine = std::cos(s[2]);
  const float force = (action == 1 ? 10.0f : -10.0f) + 0.05f * s[3] * s[3] * sine;
  const float angular = (9.8f * sine - cosine * force / 1.1f) /
                        (0.5f * (4.0f / 3.0f - 0.1f * cosine * cosine / 1.1f));
  const float linear = (force - 0.05f * angular * cosine) / 1.1f;
  return {s[0] + 0.02f * s[1], s[1] + 0.02f * linear, s[2] + 0.02f * s[3], s[3] + 0.02f * angular};
}

absl::Status Play(const char* server) {
  auto client = spikeserve::Client::Connect(server);
  if (!client.ok()) return client.status();
  spikeserve::v1::OpenSessionRequest request;
  request.set_policy("cartpole");
  auto session = spikeserve::RemoteSession::Open(client->get(), request);
  if (!session.ok()) return session.status();

  std::vector<float> state = {0.01f, -0.02f, 0.03f, 0.04f};
  double total = 0.0;
  while (total < 500.0 && std::abs(state[0]) < 2.4f && std::abs(state[2]) < 0.21f) {
    const auto answer = session->Act(state, /*reward=*/total > 0.0 ? 1.0 : 0.0);
    if (!answer.ok()) return answer.status();
    state = Step(state, answer->action().discrete());
    total += 1.0;
  }
  std::cout << "return " << total << "\n";
  return session->Close();
}

}  // namespace

int main(int argc, char** argv) {
  const absl::Status played = Play(argc > 1 ? argv[1] : "127.0.0.1:50051");
  if (!played.ok()) std::cerr << "call: " << played << "\n";
  return played.ok() ? 0 : 1;
}
