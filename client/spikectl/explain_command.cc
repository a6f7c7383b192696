#include <cstdint>
#include <iostream>
#include <string>

#include "absl/flags/flag.h"
#include "absl/strings/str_cat.h"
#include "client/spikectl/agent.h"
#include "client/spikectl/agent_flags.h"
#include "client/spikectl/commands.h"
#include "client/spikectl/common_flags.h"
#include "client/spikectl/explain_report.h"
#include "proto/json.h"

ABSL_FLAG(std::string, session, "",
          "Session whose last decision to explain; empty: one that is opened, plays --steps of "
          "--env and is closed again");
ABSL_FLAG(int32_t, steps, 20, "Decisions to make before the last one is explained");

namespace spikeserve {
namespace {

// Of a session that plays from here.
absl::StatusOr<v1::ExplainResponse> PlayAndExplain(Environment& environment, Client& client) {
  auto opened = OpenSessionFromFlags(environment, client);
  if (!opened.ok()) return opened.status();
  RemoteSession& session = opened->session;
  const absl::Status played =
      PlaySteps(environment, session, absl::GetFlag(FLAGS_seed), absl::GetFlag(FLAGS_steps));
  auto explained = played.ok() ? client.Explain(session.session_id())
                               : absl::StatusOr<v1::ExplainResponse>(played);
  const absl::Status closed = session.Close();
  if (explained.ok() && !closed.ok()) return closed;
  return explained;
}

}  // namespace

absl::Status ExplainCommand() {
  const std::string session = absl::GetFlag(FLAGS_session);
  if (!session.empty()) {  // which nobody plays, so that the flags for that would do nothing
    if (auto status = CheckFlags("explain --session", "session"); !status.ok()) return status;
  }
  if (const int32_t steps = absl::GetFlag(FLAGS_steps); steps < 1) {
    return absl::InvalidArgumentError(
        absl::StrCat("--steps: expected at least 1, received ", steps));
  }
  const auto environment = EnvironmentFromFlags();
  if (!environment.ok()) return environment.status();
  const auto client = ConnectToServer();
  if (!client.ok()) return client.status();
  const auto explained =
      session.empty() ? PlayAndExplain(**environment, **client) : (*client)->Explain(session);
  if (!explained.ok()) return explained.status();
  if (!absl::GetFlag(FLAGS_json)) {
    std::cout << ExplainToText(*explained);
    return absl::OkStatus();
  }
  const auto json = MessageToJson(*explained);
  if (!json.ok()) return json.status();
  std::cout << *json << "\n";
  return absl::OkStatus();
}

}  // namespace spikeserve
