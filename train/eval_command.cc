#include <memory>
#include <string>

#include "absl/flags/flag.h"
#include "absl/strings/str_cat.h"
#include "core/model/policy_file.h"
#include "train/commands.h"
#include "train/common_flags.h"
#include "train/evaluation.h"

ABSL_FLAG(std::string, policy, "", "eval: the policy file to play");

namespace spikeserve {

absl::Status EvalCommand() {
  const std::string path = absl::GetFlag(FLAGS_policy);
  if (path.empty()) return absl::InvalidArgumentError("policy: expected a policy file");
  absl::StatusOr<Policy> policy = ReadPolicyFile(path);
  if (!policy.ok()) return policy.status();
  policy->environment = absl::GetFlag(FLAGS_env).value_or(policy->environment);
  const ModelConfig config = policy->config;
  EvaluationOptions options = {.episodes = absl::GetFlag(FLAGS_episodes)};
  options.first_seed = absl::GetFlag(FLAGS_seed).value_or(options.first_seed);
  const absl::StatusOr<Evaluation> evaluation =
      Evaluate(std::make_shared<const Policy>(*std::move(policy)), options);
  if (!evaluation.ok()) return evaluation.status();
  PrintEvaluation(*evaluation, config);
  return absl::OkStatus();
}

}  // namespace spikeserve
