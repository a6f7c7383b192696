// spikeload: a load test of a spikeserve server, in closed loop or at a rate.
#include <iostream>
#include <string>
#include <vector>

#include "absl/flags/flag.h"
#include "absl/flags/parse.h"
#include "absl/flags/usage.h"
#include "absl/status/status.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "client/tools/security_flags.h"
#include "loadtest/load_test.h"

namespace spikeserve {

// A duration whose unit may be left out.
struct Seconds {
  absl::Duration value;
};

bool AbslParseFlag(absl::string_view text, Seconds* seconds, std::string* error) {
  double number = 0.0;
  if (absl::SimpleAtod(text, &number)) {
    seconds->value = absl::Seconds(number);
    return true;
  }
  *error = "expected seconds, or a number with a unit such as 500ms, 60s or 2m";
  return absl::ParseDuration(text, &seconds->value);
}

std::string AbslUnparseFlag(const Seconds& seconds) { return absl::FormatDuration(seconds.value); }

}  // namespace spikeserve

ABSL_FLAG(std::string, server, spikeserve::LoadOptions().server, "HOST:PORT of the server");
ABSL_FLAG(std::string, mode, "unary", "How requests travel: unary, stream or batch");
ABSL_FLAG(int32_t, sessions, spikeserve::LoadOptions().sessions, "Sessions at a time");
ABSL_FLAG(int32_t, streams, spikeserve::LoadOptions().streams,
          "Callers at a time, which share the sessions; each has its own connection, and in stream "
          "mode its own stream");
ABSL_FLAG(spikeserve::Seconds, duration, {spikeserve::LoadOptions().duration},
          "How long requests are sent, in seconds or with a unit: 60, 500ms, 2m");
ABSL_FLAG(absl::Duration, call_timeout, spikeserve::LoadOptions().call_timeout,
          "How long a call may take before it counts as failed; a stream fails after four times "
          "this without an answer");
ABSL_FLAG(std::string, policy, "", "Policy to ask for; empty: the first one served");
ABSL_FLAG(std::string, learning_scope, "",
          "session or fleet: every session samples and learns, a head of its own or the fleet's; "
          "empty: frozen");
ABSL_FLAG(int32_t, episode_steps, spikeserve::LoadOptions().episode_steps,
          "Steps after which a session ends its episode");
ABSL_FLAG(int32_t, batch_size, spikeserve::LoadOptions().batch_size,
          "Batch mode: most requests in a batch; 0: all that a caller has");
ABSL_FLAG(
    double, rate, 0.0,
    "Requests a second, on a fixed schedule, latencies counted from when a request was due; 0: "
    "closed loop, every session sends its next request when it has the answer");
ABSL_FLAG(absl::Duration, pause_after_error, spikeserve::LoadOptions().pause_after_error,
          "How long a caller rests after a request that failed for no lasting reason; 0 to flood a "
          "server that refuses");
ABSL_FLAG(double, observation_bound, spikeserve::LoadOptions().observation_bound,
          "Random observations are within plus and minus this, in environment units");
ABSL_FLAG(uint64_t, seed, 0, "Seed of the random observations");
ABSL_FLAG(bool, json, false, "Print one JSON object instead of text");

namespace spikeserve {
namespace {

absl::StatusOr<LoadOptions> OptionsFromFlags() {
  const auto mode = ParseLoadMode(absl::GetFlag(FLAGS_mode));
  if (!mode.ok()) return mode.status();
  const auto learning_scope = ParseLearningScope(absl::GetFlag(FLAGS_learning_scope));
  if (!learning_scope.ok()) return learning_scope.status();
  auto security = SecurityFromFlags();
  if (!security.ok()) return security.status();
  LoadOptions options;
  options.security = *std::move(security);
  options.server = absl::GetFlag(FLAGS_server);
  options.mode = *mode;
  options.sessions = absl::GetFlag(FLAGS_sessions);
  options.streams = absl::GetFlag(FLAGS_streams);
  options.duration = absl::GetFlag(FLAGS_duration).value;
  options.call_timeout = absl::GetFlag(FLAGS_call_timeout);
  options.policy = absl::GetFlag(FLAGS_policy);
  options.learning_scope = *learning_scope;
  options.episode_steps = absl::GetFlag(FLAGS_episode_steps);
  options.batch_size = absl::GetFlag(FLAGS_batch_size);
  options.pause_after_error = absl::GetFlag(FLAGS_pause_after_error);
  options.rate = absl::GetFlag(FLAGS_rate);
  options.observation_bound = absl::GetFlag(FLAGS_observation_bound);
  options.seed = absl::GetFlag(FLAGS_seed);
  return options;
}

// Prints the report. An error also where requests failed.
absl::Status Run(const std::vector<char*>& arguments) {
  if (arguments.size() > 1) {
    return absl::InvalidArgumentError(
        absl::StrCat("expected flags alone, received \"", arguments[1], "\""));
  }
  const auto options = OptionsFromFlags();
  if (!options.ok()) return options.status();
  const auto report = RunLoadTest(*options);
  if (!report.ok()) return report.status();
  if (absl::GetFlag(FLAGS_json)) {
    std::cout << report->ToJson().dump(2) << std::endl;
  } else {
    std::cout << report->ToText() << std::flush;
  }
  if (report->errors == 0) return absl::OkStatus();
  return absl::Status(report->first_error.code(),
                      absl::StrCat(report->errors, " requests failed, the first one with: ",
                                   report->first_error.message()));
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  // As spikeserve does: the tests keep the check, and a load generator should cost little itself.
  absl::SetMutexDeadlockDetectionMode(absl::OnDeadlockCycle::kIgnore);
  absl::SetProgramUsageMessage(
      "spikeload [--flag=value ...]: a load test, in closed loop or at a rate");
  const absl::Status status = spikeserve::Run(absl::ParseCommandLine(argc, argv));
  if (status.ok()) return 0;
  std::cerr << "spikeload: " << status.message() << " (" << absl::StatusCodeToString(status.code())
            << ")\n";
  return 1;
}
