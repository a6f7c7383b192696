#include <filesystem>
#include <iostream>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/spikectl/commands.h"
#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/dataset/policy_description.h"
#include "core/dataset/recordings.h"
#include "core/model/policy_file.h"

namespace spikeserve {
namespace {

struct AnnotateFlags {
  std::string policy;
  std::string out;  // empty: the policy file itself
  std::string features;
  std::string data;
};

// Adds what the recordings say about the robot.
absl::Status AddData(const std::string& path, Policy* policy) {
  ASSIGN_OR_RETURN(auto datasets, ReadRecordings(path));
  ASSIGN_OR_RETURN(const Dataset dataset, Concatenate(std::move(datasets)));
  if (dataset.observation_size != policy->observation_size() ||
      dataset.action_space != policy->action_space) {
    return absl::InvalidArgumentError(
        absl::StrCat("--data: expected observations of ", policy->observation_size(),
                     " elements and the policy's actions, received those of ", dataset.environment,
                     " with ", dataset.observation_size, " elements"));
  }
  if (const auto status = CheckRecordedNames(dataset.recipe, *policy); !status.ok()) {
    return Annotate(status, path);
  }
  AddNames(dataset.recipe, policy);
  return AddWiringModel(dataset.episodes, policy);
}

absl::Status AnnotatePolicy(const AnnotateFlags& flags) {
  if (flags.features.empty() && flags.data.empty()) {
    return absl::InvalidArgumentError("--features, --data: expected one of them, received neither");
  }
  ASSIGN_OR_RETURN(Policy policy, ReadPolicyFile(flags.policy));
  if (!flags.features.empty()) {
    ASSIGN_OR_RETURN(const std::string text, ReadFile(flags.features));
    auto features = ParseFeatures(text);
    if (!features.ok()) return Annotate(features.status(), flags.features);
    policy.features = *std::move(features);
  }
  if (!flags.data.empty()) RETURN_IF_ERROR(AddData(flags.data, &policy));
  const std::string out = flags.out.empty() ? flags.policy : flags.out;
  RETURN_IF_ERROR(WritePolicyFile(policy, out));
  std::cout << out << ": " << policy.features.observation.size() << " names of elements"
            << (policy.wiring == nullptr ? "" : ", and a model of the observations") << "\n";
  const std::string signature = absl::StrCat(out, ".sig");
  if (std::error_code ignored; std::filesystem::exists(signature, ignored)) {
    std::cout << signature << " is of the former content. Sign again: openssl pkeyutl -sign -rawin "
              << "-inkey private.pem -in " << out << " -out " << signature << "\n";
  }
  return absl::OkStatus();
}

}  // namespace

void AddPolicyCommands(Command program) {
  const Command policy = program.AddCommand("policy", "Changes policy files");
  const Command annotate = policy.AddCommand(
      "annotate", "Adds names of the elements, and a model to recognise wrong wiring");
  const auto flags = std::make_shared<AnnotateFlags>();
  annotate.Flags("Annotating")
      .Add("policy", "FILE", &flags->policy, "Policy file to read")
      .Add("features", "FILE", &flags->features,
           "JSON: {\"observation\": [{\"name\": \"x\", \"unit\": \"m\"}], \"action\": [...]}")
      .Add("data", "FILE", &flags->data, "Dataset or recordings that the robot was wired right in")
      .Add("out", "FILE", &flags->out, "Policy file to write; default: the one that is read");
  annotate.SetAction([flags] { return AnnotatePolicy(*flags); });
}

}  // namespace spikeserve
