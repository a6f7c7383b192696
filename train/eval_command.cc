#include <cmath>
#include <cstdio>
#include <memory>
#include <string>
#include <vector>

#include "absl/flags/flag.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/model/policy_file.h"
#include "train/commands.h"
#include "train/common_flags.h"
#include "train/evaluation/ablation.h"
#include "train/evaluation/evaluation.h"
#include "train/evaluation/return_response.h"

ABSL_FLAG(std::string, policy, "", "eval: the policy file to play");
ABSL_FLAG(std::vector<std::string>, target_returns, {},
          "eval: the returns to ask for, comma-separated (default: the policy's own)");
ABSL_FLAG(std::vector<std::string>, ablate, {},
          "eval: parts of the policy to switch off, comma-separated: context (of one timestep), "
          "attention (uniform), phase, routing (uniform), return");

namespace spikeserve {

namespace {

absl::StatusOr<std::vector<double>> TargetReturnsFromFlags() {
  std::vector<double> targets;
  for (const std::string& text : absl::GetFlag(FLAGS_target_returns)) {
    double target = 0.0;
    if (!absl::SimpleAtod(text, &target) || !std::isfinite(target)) {
      return absl::InvalidArgumentError(
          absl::StrCat("target_returns: expected finite numbers, received '", text, "'"));
    }
    targets.push_back(target);
  }
  return targets;
}

// --policy without what --ablate switches off, in the environment of --env.
absl::StatusOr<Policy> PolicyFromFlags() {
  const std::string path = absl::GetFlag(FLAGS_policy);
  if (path.empty()) return absl::InvalidArgumentError("policy: expected a policy file");
  absl::StatusOr<Policy> policy = ReadPolicyFile(path);
  if (!policy.ok()) return policy;
  policy->environment = absl::GetFlag(FLAGS_env).value_or(policy->environment);
  for (const std::string& part : absl::GetFlag(FLAGS_ablate)) {
    if (auto status = Ablate(part, &*policy); !status.ok()) return status;
  }
  return policy;
}

}  // namespace

absl::Status EvalCommand() {
  absl::StatusOr<Policy> policy = PolicyFromFlags();
  if (!policy.ok()) return policy.status();
  const absl::StatusOr<std::vector<double>> targets = TargetReturnsFromFlags();
  if (!targets.ok()) return targets.status();
  EvaluationOptions options = {.episodes = absl::GetFlag(FLAGS_episodes)};
  options.first_seed = absl::GetFlag(FLAGS_seed).value_or(options.first_seed);
  if (targets->size() > 1) {
    const absl::StatusOr<ReturnResponse> response =
        MeasureReturnResponse(*policy, *targets, options);
    if (!response.ok()) return response.status();
    const bool json = absl::GetFlag(FLAGS_json);
    std::fputs((json ? ToJson(*response).dump(2) + "\n" : ToText(*response)).c_str(), stdout);
    return absl::OkStatus();
  }
  if (!targets->empty()) policy->target_return = static_cast<float>(targets->front());
  const ModelConfig config = policy->config;
  const absl::StatusOr<Evaluation> evaluation =
      Evaluate(std::make_shared<const Policy>(*std::move(policy)), options);
  if (!evaluation.ok()) return evaluation.status();
  PrintEvaluation(*evaluation, config);
  return absl::OkStatus();
}

}  // namespace spikeserve
