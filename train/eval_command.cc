#include <cmath>
#include <cstdio>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/model/policy_file.h"
#include "train/commands.h"
#include "train/evaluation/ablation.h"
#include "train/evaluation/evaluation.h"
#include "train/evaluation/return_response.h"
#include "train/record_flags.h"

namespace spikeserve {
namespace {

struct EvalFlags {
  std::string policy;
  std::optional<std::string> env;  // absent: the policy's
  EvaluationOptions options;
  std::vector<std::string> target_returns;  // empty: the default of the policy
  std::vector<std::string> ablate;
  bool json = false;
};

absl::StatusOr<std::vector<double>> ParseTargetReturns(const EvalFlags& flags) {
  std::vector<double> targets;
  for (const std::string& text : flags.target_returns) {
    double target = 0.0;
    if (!absl::SimpleAtod(text, &target) || !std::isfinite(target)) {
      return absl::InvalidArgumentError(
          absl::StrCat("--target_returns: expected finite numbers, received \"", text, "\""));
    }
    targets.push_back(target);
  }
  return targets;
}

// Reads --policy for the environment of --env, and switches off the parts of --ablate.
absl::StatusOr<Policy> ReadPolicy(const EvalFlags& flags) {
  if (flags.policy.empty()) {
    return absl::InvalidArgumentError("--policy: expected a policy file, received none");
  }
  absl::StatusOr<Policy> policy = ReadPolicyFile(flags.policy);
  if (!policy.ok()) return policy;
  policy->environment = flags.env.value_or(policy->environment);
  for (const std::string& part : flags.ablate) {
    if (auto status = Ablate(part, &*policy); !status.ok()) return NameFlag(status);
  }
  return policy;
}

absl::Status EvaluatePolicy(const EvalFlags& flags) {
  absl::StatusOr<Policy> policy = ReadPolicy(flags);
  if (!policy.ok()) return policy.status();
  const absl::StatusOr<std::vector<double>> targets = ParseTargetReturns(flags);
  if (!targets.ok()) return targets.status();
  if (targets->size() > 1) {
    const absl::StatusOr<ReturnResponse> response =
        MeasureReturnResponse(*policy, *targets, flags.options);
    if (!response.ok()) return response.status();
    std::fputs((flags.json ? ToJson(*response).dump(2) + "\n" : ToText(*response)).c_str(), stdout);
    return absl::OkStatus();
  }
  if (!targets->empty()) policy->target_return = static_cast<float>(targets->front());
  const ModelConfig config = policy->config;
  const absl::StatusOr<Evaluation> evaluation =
      Evaluate(std::make_shared<const Policy>(*std::move(policy)), flags.options);
  if (!evaluation.ok()) return evaluation.status();
  std::fputs((flags.json ? ToJson(*evaluation, config).dump(2) + "\n" : ToText(*evaluation, config))
                 .c_str(),
             stdout);
  return absl::OkStatus();
}

}  // namespace

void AddEvalCommand(Program& program) {
  const Command command = program.root().AddCommand("eval", "Plays a policy in closed loop");
  const auto flags = std::make_shared<EvalFlags>();
  command.Flags("Playing")
      .Add("policy", "FILE", &flags->policy, "Policy file")
      .Add("env", "ID", &flags->env, "Environment; default: the policy's")
      .Add("episodes", "N", &flags->options.episodes, "Episodes to play")
      .Add("seed", "N", &flags->options.first_seed,
           "Seed of the first episode; each later one adds 1")
      .AddList("target_returns", "RETURN,...", &flags->target_returns,
               "Target returns; default: that of the policy")
      .AddList("ablate", "PART,...", &flags->ablate,
               "Parts to switch off: context, attention, phase, routing, return")
      .AddSwitch("json", &flags->json, "Print one JSON object instead of text");
  command.SetAction([flags] { return EvaluatePolicy(*flags); });
}

}  // namespace spikeserve
