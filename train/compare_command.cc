#include <cstdio>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/environment/environment.h"
#include "train/baselines/comparison.h"
#include "train/baselines/verdict.h"
#include "train/commands.h"
#include "train/decided_episodes.h"
#include "train/evaluation/evaluation.h"
#include "train/record_flags.h"
#include "train/recording/policy_player.h"

namespace spikeserve {
namespace {

struct CompareFlags {
  std::string policy;
  std::vector<std::string> data;
  int data_memory = 4096;  // MiB
  double validation = 0.1;
  uint64_t seed = 0;
  EvaluationOptions evaluation;
  std::string out;
  bool json = false;
};

absl::Status CheckFlags(const CompareFlags& flags) {
  if (flags.data.empty()) {
    return InvalidArgument("--data", "the datasets of its training", "none");
  }
  if (!(flags.validation >= 0.0 && flags.validation < 1.0)) {
    return InvalidArgument("--validation", "0 or more, below 1", flags.validation);
  }
  const absl::Status status = flags.evaluation.Validate();
  return status.ok() ? status : NameFlag(status);
}

absl::Status ComparePolicy(const CompareFlags& flags) {
  ASSIGN_OR_RETURN(const auto policy, ReadRequiredPolicy(flags.policy));
  RETURN_IF_ERROR(CheckFlags(flags));
  ASSIGN_OR_RETURN(const EpisodeSource source,
                   EpisodeSource::Open(flags.data, int64_t{flags.data_memory} << 20));
  RETURN_IF_ERROR(CheckSpacesMatch(*policy, source.dataset()));
  RETURN_IF_ERROR(MakeDirectoryOf(flags.out));  // before it fits, for minutes
  ASSIGN_OR_RETURN(const BaselineData data, ReadBaselineData(source, flags.validation));
  BaselineComparison comparison = CompareWithBaselines(policy, data, flags.seed);
  if (MakeEnvironment(policy->environment).ok()) {
    ASSIGN_OR_RETURN(const Evaluation played, Evaluate(policy, flags.evaluation));
    RETURN_IF_ERROR(PlayBaselines(policy->environment, flags.evaluation.first_seed, played.returns,
                                  &comparison));
  }
  const PolicyVerdict verdict =
      Judge(comparison, ActionNames(source.dataset()), /*loss_fall=*/std::nullopt);
  const auto json_of = [&](bool with_weights) {
    nlohmann::ordered_json json = ToJson(comparison, with_weights);
    json["verdict"] = ToJson(verdict);
    return json;
  };
  if (!flags.out.empty()) {
    const std::string text = json_of(/*with_weights=*/true).dump() + "\n";
    RETURN_IF_ERROR(WriteFileAtomically(flags.out, {text}));
  }
  const std::string text = flags.json ? json_of(/*with_weights=*/false).dump(2) + "\n"
                                      : ToText(comparison) + ToText(verdict);
  std::fputs(text.c_str(), stdout);
  return absl::OkStatus();
}

}  // namespace

void AddCompareCommand(Program& program) {
  const Command command = program.root().AddCommand(
      "compare", "Compares a policy with lines and perceptrons on its data");
  const auto flags = std::make_shared<CompareFlags>();
  command.Flags("Comparison")
      .Add("policy", "FILE", &flags->policy, "Policy file")
      .AddList("data", "FILE,...", &flags->data, "Datasets of its training")
      .Add("data_memory", "MIB", &flags->data_memory,
           "Memory for the episodes of --data; more are read in parts")
      .Add("validation", "SHARE", &flags->validation, "Share of episodes held out")
      .Add("episodes", "N", &flags->evaluation.episodes,
           "Episodes that all play, if spiketrain has the environment")
      .Add("first_seed", "N", &flags->evaluation.first_seed,
           "Seed of the first start; later episodes count on")
      .Add("seed", "N", &flags->seed, "Seed of the random weights of perceptrons")
      .Add("out", "FILE", &flags->out, "File for the figures and the weights, as JSON")
      .AddSwitch("json", &flags->json, "Print one JSON object instead of text");
  command.SetAction([flags] { return ComparePolicy(*flags); });
}

}  // namespace spikeserve
