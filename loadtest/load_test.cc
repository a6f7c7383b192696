#include "loadtest/load_test.h"

#include <algorithm>
#include <memory>
#include <thread>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/client.h"
#include "loadtest/caller.h"

namespace spikeserve {
namespace {

// One attempt a call, so that every failure is seen and counted.
absl::StatusOr<std::unique_ptr<Client>> Connect(const std::string& server) {
  constexpr absl::Duration kPatience = absl::Seconds(3);
  ClientOptions client_options;
  client_options.retry.max_attempts = 1;
  auto client = Client::Create(server, client_options);
  if (!client.ok()) return client.status();
  if (absl::Status status = (*client)->WaitForConnected(kPatience); !status.ok()) {
    return absl::Status(status.code(), absl::StrCat("--server: ", server, ": ", status.message()));
  }
  return client;
}

// The name of the policy to ask for.
absl::StatusOr<std::string> ChoosePolicy(Client& client, const std::string& name) {
  if (!name.empty()) return name;
  const auto served = client.ListPolicies();
  if (!served.ok()) return served.status();
  if (served->policies().empty()) return absl::NotFoundError("--policy: the server has no policy");
  return served->policies(0).name();
}

// The agents `index`, `index` + `options.streams`, ...
absl::StatusOr<std::vector<SimulatedAgent>> OpenAgents(const LoadOptions& options,
                                                       const std::string& policy, int index,
                                                       Client* client) {
  std::vector<SimulatedAgent> agents;
  for (int i = index; i < options.sessions; i += options.streams) {
    const uint64_t seed = options.seed + static_cast<uint64_t>(i);
    v1::OpenSessionRequest request;
    request.set_policy(policy);
    request.set_seed(seed);
    const auto opened = client->OpenSession(request);
    if (!opened.ok()) return opened.status();
    const int first_episode_steps = 1 + i % options.episode_steps;
    agents.emplace_back(RemoteSession(client, opened->session_id(), 0),
                        static_cast<int>(opened->observation_size()), first_episode_steps,
                        options.episode_steps, seed);
  }
  return agents;
}

LoadReport RunCallers(std::vector<Caller>& callers, absl::Duration duration) {
  std::vector<LoadReport> reports(callers.size());
  std::vector<std::thread> threads;
  for (size_t i = 0; i < callers.size(); ++i) {
    threads.emplace_back([&callers, &reports, i, duration] {
      reports[i] = callers[i].Run(absl::ToChronoNanoseconds(duration));
    });
  }
  for (std::thread& thread : threads) thread.join();
  LoadReport sum;
  for (const LoadReport& report : reports) sum.Merge(report);
  return sum;
}

}  // namespace

absl::StatusOr<LoadReport> RunLoadTest(const LoadOptions& options) {
  if (absl::Status status = options.Validate(); !status.ok()) return status;
  std::vector<std::unique_ptr<Client>> clients;
  std::vector<Caller> callers;
  for (int i = 0; i < std::min(options.streams, options.sessions); ++i) {
    auto client = Connect(options.server);
    if (!client.ok()) return client.status();
    clients.push_back(*std::move(client));
    const auto policy = ChoosePolicy(*clients.back(), options.policy);
    if (!policy.ok()) return policy.status();
    auto agents = OpenAgents(options, *policy, i, clients.back().get());
    if (!agents.ok()) return agents.status();
    callers.emplace_back(MakeExchange(options.mode, options.batch_size, clients.back().get()),
                         *std::move(agents));
  }
  LoadReport report = RunCallers(callers, options.duration);
  absl::Status closed;
  for (Caller& caller : callers) closed.Update(caller.CloseSessions());
  // Where decisions failed, their first error says more than what followed from it.
  if (report.errors == 0 && !closed.ok()) return closed;
  return report;
}

}  // namespace spikeserve
