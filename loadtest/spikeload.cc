// spikeload: a load test of spikeserve servers, in closed loop or at a rate.
#include <algorithm>
#include <iostream>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "client/tools/security_flags.h"
#include "core/base/status_macros.h"
#include "core/cli/printable_output.h"
#include "core/cli/program.h"
#include "loadtest/caller.h"
#include "loadtest/load_options.h"
#include "loadtest/load_report.h"
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
    if (options.durability.has_value()) {
      v1::Durability durability = v1::DURABILITY_DEFAULT;
      v1::Durability_Parse(absl::AsciiStrToUpper(ToString(*options.durability)), &durability);
      request.set_durability(durability);
    }
    if (options.learning_scope.has_value()) {
      request.set_action_selection(v1::SAMPLE);
      const bool is_fleet = *options.learning_scope == Scope::kFleet;
      request.mutable_learning()->set_scope(is_fleet ? v1::LearningConfig::FLEET
                                                     : v1::LearningConfig::SESSION);
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

// Opens the sessions, runs the callers, and closes the sessions. Returns INVALID_ARGUMENT if
// `options` are invalid, NOT_FOUND for an unknown policy, UNAVAILABLE if the server cannot be
// reached, or the error of opening or closing a session. Failed decisions are not an error; the
// report counts them.
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

struct LoadFlags {
  LoadOptions options;  // without the security options
  SecurityFlags security;
  bool json = false;
};

void AddLoadFlags(FlagGroup load, LoadOptions* options) {
  load.Add("mode", EnumKind<LoadMode>(), &options->mode, "How requests are sent")
      .Add("sessions", "N", &options->sessions, "Open sessions")
      .Add("streams", "N", &options->streams,
           "Callers, each with a connection, that share the sessions")
      .Add("duration", "DURATION", &options->duration, "Duration of the test")
      .Add("rate", "N", &options->rate, "Requests a second on a fixed schedule; 0: closed loop")
      .Add("batch_size", "N", &options->batch_size,
           "Largest number of requests in a batch; 0: all of a caller")
      .Add("call_timeout", "DURATION", &options->call_timeout,
           "Time until a call fails; a stream has four times this")
      .Add("pause_after_error", "DURATION", &options->pause_after_error,
           "Pause of a caller after a failure; 0: none")
      .AddSwitch("retry", &options->retry,
                 "Repeat failed calls, as the client library does by default");
}

void AddAgentFlags(FlagGroup agents, LoadOptions* options) {
  agents.Add("policy", "NAME", &options->policy, "Policy; default: the first one served")
      .Add("learning_scope", EnumKind<Scope>(), &options->learning_scope,
           "Head that learns; default: none")
      .Add("durability", EnumKind<Durability>(), &options->durability,
           "What survives the loss of a server; default: the server's")
      .Add("episode_steps", "N", &options->episode_steps, "Steps of an episode")
      .Add("observation_bound", "X", &options->observation_bound,
           "Random observations are within plus and minus this")
      .Add("observations", "FILE", &options->observations,
           "Rewards and observations, a line for each step; default: random")
      .Add("seed", "N", &options->seed, "Seed of the random observations");
}

void AddFlags(Command program, LoadFlags* flags) {
  program.Flags("Server")
      .Add("server", "HOST:PORT,...", &flags->options.server,
           "Address, or several; default: $SPIKESERVE_SERVER")
      .AddSwitch("json", &flags->json, "Print one JSON object instead of text");
  AddLoadFlags(program.Flags("Load"), &flags->options);
  AddAgentFlags(program.Flags("Agents"), &flags->options);
  AddSecurityFlags(program, &flags->security);
}

// Runs the load test and prints the report. Returns an error also if requests failed.
absl::Status Run(const LoadFlags& flags) {
  // Abseil's deadlock detection slows every lock. The tests run with it, programs without it.
  absl::SetMutexDeadlockDetectionMode(absl::OnDeadlockCycle::kIgnore);
  LoadOptions options = flags.options;
  ASSIGN_OR_RETURN(options.security, ReadSecurityOptions(flags.security));
  ASSIGN_OR_RETURN(const auto report, RunLoadTest(options));
  if (flags.json) {
    std::cout << report.ToJson().dump(2) << std::endl;
  } else {
    std::cout << report.ToText() << std::flush;
  }
  if (report.errors == 0) return absl::OkStatus();
  return absl::Status(report.first_error.code(),
                      absl::StrCat(report.errors, " requests failed, the first one with: ",
                                   report.first_error.message()));
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  spikeserve::SilenceGrpc();
  const spikeserve::PrintableOutput output;
  spikeserve::LoadFlags flags;
  spikeserve::Program program("spikeload", "Puts a load on a spikeserve server and measures it",
                              spikeserve::ErrorCodes::kShown);
  spikeserve::AddFlags(program.root(), &flags);
  program.root().SetAction([&flags] { return spikeserve::Run(flags); });
  return program.Run(argc, argv);
}
