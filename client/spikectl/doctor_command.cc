#include <algorithm>
#include <cmath>
#include <filesystem>
#include <iostream>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "client/spikectl/commands.h"
#include "core/agent/wiring_check.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/dataset/policy_description.h"
#include "core/dataset/recordings.h"
#include "core/engine/engine.h"
#include "core/model/policy_file.h"
#include "core/model/wiring_model.h"
#include "spikeserve/client.h"

namespace spikeserve {
namespace {

struct DoctorFlags {
  std::string policy;
  std::string observations;
  std::string session;
};

// Returns the policy of a file, or the one that the server serves by this name.
absl::StatusOr<Policy> FindPolicy(const ServerFlags& server, const std::string& name) {
  if (std::error_code ignored; std::filesystem::is_regular_file(name, ignored)) {
    return ReadPolicyFile(name);
  }
  ASSIGN_OR_RETURN(const auto client, Connect(server));
  v1::OpenSessionRequest request;
  request.set_policy(name);
  request.set_durability(v1::NONE);
  ASSIGN_OR_RETURN(const auto opened, client->OpenSession(request));
  const auto exported = client->ExportSession(opened.session_id(), /*include_policy=*/true);
  (void)client->CloseSession(opened.session_id());
  if (!exported.ok()) return exported.status();
  if (exported->policy_file().empty()) {
    return absl::FailedPreconditionError(
        "--policy: expected a file, because the server does not send policies, received a name");
  }
  return ParsePolicyFile(exported->policy_file());
}

// What the recordings show of one element.
struct Seen {
  double low = std::numeric_limits<double>::infinity();
  double high = -std::numeric_limits<double>::infinity();
};

struct Diagnosis {
  std::vector<Seen> elements;
  int64_t steps = 0;
  int64_t first_step = 0;                // of the verdict, counted over all episodes
  std::optional<WiringVerdict> verdict;  // the last one
};

// Plays the observations of `episode` to the check.
void Check(const Policy& policy, const Episode& episode, WiringState* state, Diagnosis* found) {
  const auto obs = static_cast<size_t>(policy.observation_size());
  const auto limit = static_cast<size_t>(HistorySize(policy.config));  // as the server has it
  History history;
  for (size_t t = 0; t <= episode.actions.size(); ++t) {
    const auto observation = absl::MakeConstSpan(episode.observations).subspan(t * obs, obs);
    if (std::isnan(observation[0])) return;
    for (size_t i = 0; i < obs; ++i) {
      const auto value = static_cast<double>(observation[i]);
      found->elements[i].low = std::min(found->elements[i].low, value);
      found->elements[i].high = std::max(found->elements[i].high, value);
    }
    const auto step = static_cast<int64_t>(t);
    if (CheckWiring(policy, step, history, observation, state)) found->first_step = found->steps;
    if (state->verdict.has_value()) found->verdict = state->verdict;
    ++found->steps;
    if (t == episode.actions.size()) return;
    history.Append(0.0f, observation, episode.actions[t], limit);
  }
}

void Print(const Policy& policy, const Diagnosis& found) {
  std::cout << absl::StrFormat("%-3s %-24s %-8s %23s %23s\n", "", "ELEMENT", "UNIT",
                               "IN TRAINING (95 %)", "SEEN");
  for (size_t i = 0; i < found.elements.size(); ++i) {
    const bool is_named = i < policy.features.observation.size();
    const double mean = policy.wiring->mean[i];
    const double reach = 2.0 * policy.wiring->deviation[i];
    std::cout << absl::StrFormat("%-3d %-24s %-8s %11.4g to %8.4g %11.4g to %8.4g\n", i,
                                 is_named ? policy.features.observation[i].name : "",
                                 is_named ? policy.features.observation[i].unit : "", mean - reach,
                                 mean + reach, found.elements[i].low, found.elements[i].high);
  }
  if (!found.verdict.has_value()) {
    std::cout << "wired right, as far as " << found.steps << " observations show\n";
    return;
  }
  std::cout << "verdict after " << found.first_step + 1
            << " observations: " << WiringText(policy, *found.verdict) << "\n";
}

absl::Status AskServer(const ServerFlags& server, const std::string& session) {
  ASSIGN_OR_RETURN(const auto client, Connect(server));
  ASSIGN_OR_RETURN(const auto state, client->GetSession(session));
  std::cout << (state.has_wiring() ? absl::StrCat("verdict: ", state.wiring().text())
                                   : "wired right, as far as the server has seen")
            << "\n";
  return absl::OkStatus();
}

absl::Status Diagnose(const ServerFlags& server, const DoctorFlags& flags) {
  if (!flags.session.empty()) return AskServer(server, flags.session);
  if (flags.policy.empty() || flags.observations.empty()) {
    return absl::InvalidArgumentError(
        "--session, or --policy and --observations: expected, received neither");
  }
  ASSIGN_OR_RETURN(const Policy policy, FindPolicy(server, flags.policy));
  if (policy.wiring == nullptr) {
    return absl::FailedPreconditionError(
        "--policy: expected a policy with a model of its observations (spikectl policy annotate), "
        "received one without");
  }
  ASSIGN_OR_RETURN(const auto datasets, ReadRecordings(flags.observations));
  Diagnosis found;
  found.elements.resize(static_cast<size_t>(policy.observation_size()));
  for (const Dataset& dataset : datasets) {
    if (dataset.observation_size != policy.observation_size() ||
        dataset.action_space != policy.action_space) {
      return absl::InvalidArgumentError(absl::StrCat(
          "--observations: expected observations of ", policy.observation_size(),
          " elements and the policy's actions, received ", dataset.observation_size, " elements"));
    }
    if (const auto status = CheckRecordedNames(dataset.recipe, policy); !status.ok()) {
      return Annotate(status, flags.observations);
    }
    WiringState state;
    for (const Episode& episode : dataset.episodes) Check(policy, episode, &state, &found);
  }
  Print(policy, found);
  return absl::OkStatus();
}

}  // namespace

void AddDoctorCommand(Command program, const ServerFlags& server) {
  const Command command = program.AddCommand("doctor", "Tests whether a robot is wired right");
  const auto flags = std::make_shared<DoctorFlags>();
  command.Flags("Robot")
      .Add("policy", "NAME", &flags->policy, "Name of a policy of the server, or a policy file")
      .Add("observations", "FILE", &flags->observations, "Recordings or dataset of the robot")
      .Add("session", "ID", &flags->session, "Session of a server; takes the place of the others");
  command.SetAction([flags, &server] { return Diagnose(server, *flags); });
}

}  // namespace spikeserve
