#include "lab/report/insight.h"

#include <utility>

#include "core/agent/agent_session.h"
#include "core/agent/explanation.h"
#include "core/base/status_macros.h"
#include "core/engine/factory/engine_factory.h"
#include "core/environment/environment.h"
#include "core/session/session_value.h"
#include "train/recording/policy_player.h"

namespace spikeserve {
namespace {

// Averages the layer's gates [gated, T, H] over ticks. Returns [H][gated].
std::vector<std::vector<double>> MeanGates(const LayerTrace& layer, const ModelConfig& config) {
  if (layer.gates.empty()) return {};
  std::vector<std::vector<double>> means(config.heads, std::vector<double>(layer.gated.size()));
  auto gate = layer.gates.begin();
  for (size_t token = 0; token < layer.gated.size(); ++token) {
    for (int tick = 0; tick < config.ticks; ++tick) {
      for (auto& head : means) head[token] += static_cast<double>(*gate++) / config.ticks;
    }
  }
  return means;
}

}  // namespace

absl::StatusOr<Insight> LookInside(std::shared_ptr<const Policy> policy, uint64_t seed) {
  ASSIGN_OR_RETURN(std::unique_ptr<Environment> environment, MakeEnvironment(policy->environment));
  RETURN_IF_ERROR(CheckSpacesMatch(*policy, *environment));
  auto served = std::make_shared<ServedPolicy>();
  served->engine = MakeEngine(policy);
  served->observer = std::make_shared<SessionObserver>();
  SessionOptions options;
  options.target_return = static_cast<double>(policy->target_return);
  options.seed = seed;
  const SteadyClock clock;
  AgentSession agent(served, NewSession("insight", std::move(options)), &clock);

  Insight insight;
  StepResult result{.observation = environment->Reset(seed)};
  for (int64_t step = 0; !result.done(); ++step) {
    ASSIGN_OR_RETURN(const Answer* answer, agent.Act(step, result.observation, result.reward));
    insight.spikes.push_back(static_cast<int64_t>(answer->counts.total_spikes()));
    result = environment->Step(answer->action);
  }
  ASSIGN_OR_RETURN(const Explanation explanation, Explain(*policy, agent.session()));
  insight.gates = MeanGates(explanation.trace.layers.front(), policy->config);
  return insight;
}

}  // namespace spikeserve
