#include "train/common_flags.h"

#include <cstdio>
#include <filesystem>
#include <memory>
#include <utility>

#include "absl/flags/flag.h"
#include "absl/strings/str_cat.h"
#include "core/model/policy_file.h"

ABSL_FLAG(absl::optional<std::string>, env, absl::nullopt,
          "environment: CartPole-v1 (default), MountainCar-v0, Acrobot-v1, Pendulum-v1, "
          "PositionOnlyCartPole-v1 or PositionOnlyPendulum-v1");
ABSL_FLAG(
    absl::optional<uint64_t>, seed, absl::nullopt,
    "dataset, train: seed of every random draw (default 0); expert, eval: the first episode's "
    "seed (default 0, 1000000)");
ABSL_FLAG(std::string, out, "",
          "dataset: what to write, a .cbor file or a directory for Minari's layout, named like "
          "cartpole-expert-v0; train: the directory to write into");
ABSL_FLAG(bool, json, false, "one JSON object on standard output instead of text");
ABSL_FLAG(int, episodes, 100, "train, eval, expert: episodes of the closed-loop evaluation");
ABSL_FLAG(int, steps, spikeserve::RecordOptions{}.steps,
          "dataset, train without --data: steps to record, at least");
ABSL_FLAG(double, expert_fraction, spikeserve::RecordOptions{}.expert_fraction,
          "dataset, train without --data: share of the steps that the expert takes, the rest are "
          "random");
ABSL_FLAG(double, disturbed_fraction, spikeserve::RecordOptions{}.disturbed_fraction,
          "dataset, train without --data: share of the steps in episodes where bursts of random "
          "actions disturb the expert, whose own action is the label");
ABSL_FLAG(
    std::string, student, "",
    "dataset, train without --data: a policy file; the rest of the steps are its own, labelled "
    "by the expert, instead of random");
ABSL_FLAG(
    bool, weigh, false,
    "dataset, train without --data: weight every label by what the worst action would lose, as "
    "far as the expert knows");
ABSL_FLAG(double, burst_rate, spikeserve::RecordOptions{}.burst_rate,
          "dataset, train without --data: largest probability of a burst to begin at a step; each "
          "disturbed episode draws its own below");
ABSL_FLAG(int, longest_burst, spikeserve::RecordOptions{}.longest_burst,
          "dataset, train without --data: most steps of a burst");
ABSL_FLAG(double, wide_start_fraction, spikeserve::RecordOptions{}.wide_start_fraction,
          "dataset, train without --data: share of the disturbed episodes that start at any "
          "velocity (Pendulum-v1)");
ABSL_FLAG(std::string, expert, "",
          "expert, dataset, train without --data: which expert; the first is the default. "
          "CartPole-v1: feedback, dial. MountainCar-v0: value_iteration, dial. Pendulum-v1: "
          "value_iteration, robust. Acrobot-v1: beam, lookahead, greedy");
ABSL_FLAG(int, beam_width, spikeserve::ExpertOptions{}.beam_width,
          "expert, dataset, train without --data: partial plans that --expert=beam keeps");
ABSL_FLAG(std::string, tables, "",
          "expert, dataset, train without --data: directory in which the experts' value tables are "
          "kept (default: the one --out is in; without either they are solved anew)");

namespace spikeserve {

namespace {

// --tables, or else the directory --out is in.
std::string TablesDirectory() {
  std::string tables = absl::GetFlag(FLAGS_tables);
  const std::filesystem::path out = absl::GetFlag(FLAGS_out);
  if (!tables.empty() || out.empty()) return tables;
  return out.has_parent_path() ? out.parent_path().string() : ".";
}

}  // namespace

ExpertOptions ExpertOptionsFromFlags() {
  const ExpertOptions defaults;
  return {.environment = absl::GetFlag(FLAGS_env).value_or(defaults.environment),
          .name = absl::GetFlag(FLAGS_expert),
          .tables_directory = TablesDirectory(),
          .beam_width = absl::GetFlag(FLAGS_beam_width)};
}

absl::StatusOr<RecordOptions> RecordOptionsFromFlags() {
  std::shared_ptr<const Policy> student;
  if (const std::string path = absl::GetFlag(FLAGS_student); !path.empty()) {
    absl::StatusOr<Policy> policy = ReadPolicyFile(path);
    if (!policy.ok()) return policy.status();
    student = std::make_shared<const Policy>(*std::move(policy));
  }
  const RecordOptions defaults;
  return RecordOptions{.expert = ExpertOptionsFromFlags(),
                       .seed = absl::GetFlag(FLAGS_seed).value_or(defaults.seed),
                       .steps = absl::GetFlag(FLAGS_steps),
                       .expert_fraction = absl::GetFlag(FLAGS_expert_fraction),
                       .disturbed_fraction = absl::GetFlag(FLAGS_disturbed_fraction),
                       .student = std::move(student),
                       .weigh = absl::GetFlag(FLAGS_weigh),
                       .burst_rate = absl::GetFlag(FLAGS_burst_rate),
                       .longest_burst = absl::GetFlag(FLAGS_longest_burst),
                       .wide_start_fraction = absl::GetFlag(FLAGS_wide_start_fraction)};
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
