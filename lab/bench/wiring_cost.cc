// Measures what the test of the wiring costs: the processor time of decisions with a policy's model
// of its observations and without it, on the same recorded episodes, in turn.
//
//   wiring_cost --policy=deploy/policies/cartpole/2/policy.safetensors --recordings=DIR

#include <time.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <iostream>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_format.h"
#include "core/agent/agent_session.h"
#include "core/base/status_macros.h"
#include "core/dataset/recordings.h"
#include "core/engine/factory/engine_factory.h"
#include "core/model/policy_file.h"
#include "core/session/session_value.h"

namespace spikeserve {
namespace {

double ProcessorSeconds() {
  timespec now;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

std::shared_ptr<const ServedPolicy> Serve(Policy policy) {
  auto served = std::make_shared<ServedPolicy>();
  const auto shared = std::make_shared<const Policy>(std::move(policy));
  served->name = "policy";
  served->version = 1;
  served->engine = MakeEngine(shared);
  served->heads = std::make_shared<TenantHeads>(shared);
  served->observer = std::make_shared<SessionObserver>();
  return served;
}

ReportedAction Reported(const Action& action, const ActionSpace& space) {
  if (space.is_discrete()) return ReportedAction(int64_t{action.discrete});
  return ReportedAction(absl::MakeConstSpan(action.continuous));
}

// Plays `episode` and returns the processor seconds of its decisions.
absl::StatusOr<double> Play(const std::shared_ptr<const ServedPolicy>& served,
                            const Episode& episode) {
  const Policy& policy = served->policy();
  const auto obs = static_cast<size_t>(policy.observation_size());
  const SteadyClock clock;
  SessionOptions options;
  options.policy = "policy";
  options.version = 1;
  options.target_return = static_cast<double>(policy.target_return);
  AgentSession agent(served, NewSession("id", std::move(options)), &clock);
  const double start = ProcessorSeconds();
  for (size_t t = 0; t < episode.actions.size(); ++t) {
    const auto observation = absl::MakeConstSpan(episode.observations).subspan(t * obs, obs);
    std::optional<ReportedAction> executed;
    if (t > 0) executed = Reported(episode.actions[t - 1], policy.action_space);
    const double reward = t > 0 ? episode.rewards[t - 1] : 0.0;
    RETURN_IF_ERROR(agent.Act(static_cast<int64_t>(t), observation, reward, executed).status());
    agent.AppendPendingAction();
  }
  return ProcessorSeconds() - start;
}

absl::Status Measure(const std::string& file, const std::string& recordings, int rounds) {
  ASSIGN_OR_RETURN(Policy policy, ReadPolicyFile(file));
  ASSIGN_OR_RETURN(const auto datasets, ReadRecordings(recordings));
  const auto with = Serve(policy);
  policy.wiring = nullptr;
  const auto without = Serve(std::move(policy));
  std::vector<double> ratios;
  double seconds = 0.0;
  int64_t decisions = 0;
  for (int round = 0; round < rounds; ++round) {
    double both[2] = {0.0, 0.0};
    for (const Dataset& dataset : datasets) {
      for (const Episode& episode : dataset.episodes) {
        for (const int side : {round % 2, 1 - round % 2}) {
          ASSIGN_OR_RETURN(const double spent, Play(side == 0 ? with : without, episode));
          both[side] += spent;
        }
        decisions += episode.steps();
      }
    }
    ratios.push_back(both[0] / both[1]);
    seconds += both[1];
  }
  std::sort(ratios.begin(), ratios.end());
  const auto quantile = [&](double q) {
    return 100.0 * (ratios[static_cast<size_t>(q * static_cast<double>(ratios.size() - 1))] - 1.0);
  };
  std::cout << absl::StrFormat(
      "%d decisions of %.1f us; with the test %+.2f %% (%d rounds, quartiles %+.2f to %+.2f)\n",
      decisions / rounds, 1e6 * seconds / static_cast<double>(decisions), quantile(0.5), rounds,
      quantile(0.25), quantile(0.75));
  return absl::OkStatus();
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  CLI::App app("Measures what the test of the wiring costs");
  std::string policy, recordings;
  int rounds = 21;
  app.add_option("--policy", policy, "Policy file")->required();
  app.add_option("--recordings", recordings, "Recordings of a server")->required();
  app.add_option("--rounds", rounds, "Times that the episodes are played")->capture_default_str();
  CLI11_PARSE(app, argc, argv);
  const absl::Status status = spikeserve::Measure(policy, recordings, rounds);
  if (!status.ok()) std::cerr << status.message() << "\n";
  return status.ok() ? 0 : 1;
}
