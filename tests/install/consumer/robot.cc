// Flies a pilot with the engine on the robot. Prints "fresh" when the server named on the command
// line has decided a beat, and then "local" when the engine has, because the server is gone.
#include <iostream>
#include <vector>

#include "absl/time/clock.h"
#include "spikeserve/client.h"
#include "spikeserve/local_engine.h"
#include "spikeserve/pilot.h"

int main(int argc, char** argv) {
  if (argc != 2) return 2;
  const auto client = spikeserve::Client::Connect(argv[1]);
  if (!client.ok()) return 1;
  spikeserve::v1::OpenSessionRequest request;
  request.set_policy("pendulum");
  const auto pilot = spikeserve::Pilot::Create(
      client->get(), request,
      {.period = absl::Milliseconds(20), .local = spikeserve::LocalEngine::FromServer()});
  if (!pilot.ok()) {
    std::cerr << pilot.status() << std::endl;
    return 1;
  }
  const std::vector<float> observation = {1.0f, 0.0f, 0.0f};
  for (const auto source : {spikeserve::ActionSource::kFresh, spikeserve::ActionSource::kLocal}) {
    while ((*pilot)->Beat(observation).source != source) absl::SleepFor(absl::Milliseconds(20));
    std::cout << spikeserve::ActionSourceName(source) << std::endl;
  }
  return 0;
}
