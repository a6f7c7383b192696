// Small random policies and synthetic inputs, for tests of sessions.
#pragma once

#include <cmath>
#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "core/agent/agent_session.h"
#include "core/agent/served_policy.h"
#include "core/engine/factory/engine_factory.h"
#include "core/model/policy.h"
#include "core/quantize/quantize_integer.h"
#include "tests/support/small_policy.h"

namespace spikeserve {

// Records the notifications of a session. Not thread-safe.
struct RecordingObserver : SessionObserver {
  int opened = 0;
  int closed = 0;
  std::vector<Answer> decisions;
  std::vector<double> returns;

  void OnOpen() override { ++opened; }
  void OnDecision(const Answer& answer) override { decisions.push_back(answer); }
  void OnEpisodeEnd(double episode_return) override { returns.push_back(episode_return); }
  void OnClose() override { ++closed; }
};

constexpr int kObservationSize = 3;

// Returns version 1 of a random policy "small" of either arithmetic, with a streaming engine and a
// fleet head, and with the model `wiring` of its observations, if it is not null.
inline std::shared_ptr<const ServedPolicy> Serve(
    const ModelConfig& config, const ActionSpace& action_space,
    std::shared_ptr<SessionObserver> observer = std::make_shared<SessionObserver>(),
    std::shared_ptr<const WiringModel> wiring = nullptr) {
  ModelConfig random = config;
  random.arithmetic = Arithmetic::kFloat32;
  Policy made = RandomPolicy(random, kObservationSize, action_space, /*seed=*/7);
  if (config.is_integer()) made = *QuantizeToInteger(made);
  made.wiring = std::move(wiring);
  auto policy = std::make_shared<const Policy>(std::move(made));
  auto served = std::make_shared<ServedPolicy>();
  served->name = "small";
  served->version = 1;
  served->heads = std::make_shared<TenantHeads>(policy);
  served->engine = MakeEngine(std::move(policy));
  served->observer = std::move(observer);
  return served;
}

// Returns options of a session of the policy that Serve() returns.
inline SessionOptions SmallOptions() {
  SessionOptions options;
  options.policy = "small";
  options.version = 1;
  options.target_return = 10.0;
  options.seed = 42;
  return options;
}

// Returns the observation of timestep t.
inline std::vector<float> ObservationAt(int64_t t) {
  std::vector<float> observation(kObservationSize);
  for (int i = 0; i < kObservationSize; ++i) {
    observation[i] = static_cast<float>(std::sin(0.7 * static_cast<double>(t) + i));
  }
  return observation;
}

// Returns the reward of the action before timestep t. Most values have no exact binary
// representation, so that tests notice a changed order of additions.
inline double RewardAt(int64_t t) { return 0.1 * static_cast<double>(t % 3); }

}  // namespace spikeserve
