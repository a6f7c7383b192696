#include "loadtest/load_test.h"

#include <algorithm>
#include <memory>
#include <thread>
#include <utility>
#include <vector>

#include "core/base/status_macros.h"
#include "loadtest/caller.h"
#include "loadtest/recorded_episode.h"
#include "spikeserve/client.h"

namespace spikeserve {
namespace {

// Returns `name`, or the first policy of the server if `name` is empty.
absl::StatusOr<std::string> ChoosePolicy(Client& client, const std::string& name) {
  if (!name.empty()) return name;
  ASSIGN_OR_RETURN(const auto served, client.ListPolicies());
  if (served.policies().empty()) return absl::NotFoundError("--policy: the server has no policy");
  return served.policies(0).name();
}

// Opens the sessions of one caller: agents `index`, `index` + options.streams, `index` + 2
// options.streams and so on.
absl::StatusOr<std::vector<SimulatedAgent>> OpenAgents(const LoadOptions& options,
                                                       const RecordedEpisode& recorded,
                                                       const std::string& policy, int index,
                                                       Client* client,
                                                       const std::shared_ptr<Route>& route) {
  std::vector<SimulatedAgent> agents;
  for (int i = index; i < options.sessions; i += options.streams) {
    const uint64_t seed = options.seed + static_cast<uint64_t>(i);
    v1::OpenSessionRequest request;
    request.set_policy(policy);
    request.set_seed(seed);
    request.set_durability(options.durability);
    if (options.learning_scope.has_value()) {
      request.set_action_selection(v1::SAMPLE);
      request.mutable_learning()->set_scope(*options.learning_scope);
    }
    ASSIGN_OR_RETURN(auto session,
                     RemoteSession::Open(client, std::move(request), /*reopens=*/true, route));
    const auto observation_size = static_cast<int>(session.opening().observation_size());
    const int first_episode_steps = 1 + i % options.episode_steps;
    if (recorded.empty()) {
      agents.emplace_back(std::move(session), observation_size, first_episode_steps,
                          options.episode_steps, seed, options.observation_bound);
    } else {
      agents.emplace_back(std::move(session), &recorded, first_episode_steps,
                          options.episode_steps);
    }
  }
  return agents;
}

// Runs caller `index` of `callers`. At a fixed rate the callers' schedules interleave.
LoadReport RunCaller(const LoadOptions& options, size_t index, size_t callers, Caller& caller) {
  const auto duration = absl::ToChronoNanoseconds(options.duration);
  if (options.rate == 0.0) return caller.RunClosedLoop(duration);
  const absl::Duration offset = absl::Seconds(static_cast<double>(index) / options.rate);
  const absl::Duration interval = absl::Seconds(static_cast<double>(callers) / options.rate);
  return caller.RunAtRate({.offset = absl::ToChronoNanoseconds(offset),
                           .interval = absl::ToChronoNanoseconds(interval)},
                          duration);
}

LoadReport RunCallers(const LoadOptions& options, std::vector<Caller>& callers) {
  std::vector<LoadReport> reports(callers.size());
  std::vector<std::thread> threads;
  for (size_t i = 0; i < callers.size(); ++i) {
    threads.emplace_back([&options, &callers, &reports, i] {
      reports[i] = RunCaller(options, i, callers.size(), callers[i]);
    });
  }
  for (std::thread& thread : threads) thread.join();
  LoadReport sum;
  for (const LoadReport& report : reports) sum.Merge(report);
  return sum;
}

}  // namespace

absl::StatusOr<LoadReport> RunLoadTest(const LoadOptions& options) {
  RETURN_IF_ERROR(options.Validate());
  ClientOptions client_options;
  if (!options.retry) client_options.retry.max_attempts = 1;  // every failure is counted
  client_options.call_timeout = options.call_timeout;
  client_options.security = options.security;
  RecordedEpisode recorded;
  if (!options.observations.empty()) {
    ASSIGN_OR_RETURN(recorded, ReadRecordedEpisode(options.observations));
  }
  std::vector<std::unique_ptr<Client>> clients;
  std::vector<Caller> callers;
  for (int i = 0; i < std::min(options.streams, options.sessions); ++i) {
    ASSIGN_OR_RETURN(auto client, Client::Connect(options.server, client_options));
    clients.push_back(std::move(client));
    ASSIGN_OR_RETURN(const auto policy, ChoosePolicy(*clients.back(), options.policy));
    // The sessions of a stream or a batch go to one server; those of single calls are spread.
    const auto route = options.mode == LoadMode::kUnary ? nullptr : MakeRoute();
    ASSIGN_OR_RETURN(auto agents,
                     OpenAgents(options, recorded, policy, i, clients.back().get(), route));
    callers.emplace_back(
        MakeExchange(options.mode, options.batch_size, clients.back().get(), route),
        std::move(agents), clients.back()->options().retry, options.pause_after_error,
        4 * options.call_timeout);
  }
  LoadReport report = RunCallers(options, callers);
  absl::Status closed;
  for (Caller& caller : callers) closed.Update(caller.CloseSessions());
  // If decisions failed, an error on closing is probably a consequence, so the report is returned:
  // its first error is more informative.
  if (report.errors == 0 && !closed.ok()) return closed;
  return report;
}

}  // namespace spikeserve
