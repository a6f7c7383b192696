// spikeload: a load test of spikeserve servers, in closed loop or at a rate.
#include <iostream>
#include <optional>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "client/tools/security_flags.h"
#include "core/base/status_macros.h"
#include "core/cli/printable_output.h"
#include "core/cli/program.h"
#include "loadtest/load_test.h"

namespace spikeserve {
namespace {

struct LoadFlags {
  LoadOptions options;  // without the security options
  SecurityFlags security;
  bool json = false;
};

template <typename T>
absl::Status Store(const absl::StatusOr<T>& parsed, T* value) {
  if (parsed.ok()) *value = *parsed;
  return parsed.status();
}

void AddLoadFlags(FlagGroup load, LoadOptions* options) {
  load.AddParsed(
          "mode", "unary|stream|batch", "unary",
          [=](const std::string& text) { return Store(ParseLoadMode(text), &options->mode); },
          "How requests are sent")
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
      .AddParsed(
          "learning_scope", "session|fleet", "",
          [=](const std::string& text) {
            return Store(ParseLearningScope(text), &options->learning_scope);
          },
          "Head that learns; default: none")
      .AddParsed(
          "durability", "none|async|sync", "",
          [=](const std::string& text) {
            return Store(ParseDurability(text), &options->durability);
          },
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
