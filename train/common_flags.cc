#include "train/common_flags.h"

#include <cstdio>

#include "absl/flags/flag.h"
#include "absl/strings/str_cat.h"

ABSL_FLAG(absl::optional<std::string>, env, absl::nullopt,
          "environment: CartPole-v1 (default), MountainCar-v0, Acrobot-v1 or Pendulum-v1");
ABSL_FLAG(absl::optional<uint64_t>, seed, absl::nullopt,
          "dataset, train: seed of every random draw (default 0); eval: the first episode's seed "
          "(default 1000000)");
ABSL_FLAG(std::string, out, "", "dataset: the file to write; train: the directory to write into");
ABSL_FLAG(bool, json, false, "one JSON object on standard output instead of text");
ABSL_FLAG(int, episodes, 100, "train, eval: episodes of the closed-loop evaluation");
ABSL_FLAG(int, steps, spikeserve::RecordOptions{}.steps,
          "dataset, train without --data: steps to record, at least");
ABSL_FLAG(double, expert_fraction, spikeserve::RecordOptions{}.expert_fraction,
          "dataset, train without --data: share of the steps that the expert takes, the rest are "
          "random");

namespace spikeserve {

RecordOptions RecordOptionsFromFlags() {
  const RecordOptions defaults;
  return {.environment = absl::GetFlag(FLAGS_env).value_or(defaults.environment),
          .seed = absl::GetFlag(FLAGS_seed).value_or(defaults.seed),
          .steps = absl::GetFlag(FLAGS_steps),
          .expert_fraction = absl::GetFlag(FLAGS_expert_fraction)};
}

absl::StatusOr<std::string> RequiredOut(absl::string_view what) {
  std::string out = absl::GetFlag(FLAGS_out);
  if (out.empty()) return absl::InvalidArgumentError(absl::StrCat("out: expected ", what));
  return out;
}

void PrintEvaluation(const Evaluation& evaluation, const ModelConfig& config) {
  const std::string text = absl::GetFlag(FLAGS_json) ? ToJson(evaluation, config).dump(2) + "\n"
                                                     : ToText(evaluation, config);
  std::fputs(text.c_str(), stdout);
}

}  // namespace spikeserve
