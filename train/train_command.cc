#include <cmath>
#include <filesystem>
#include <memory>
#include <string>
#include <system_error>
#include <utility>

#include "absl/flags/flag.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/types/optional.h"
#include "core/environment/environment.h"
#include "core/model/policy_file.h"
#include "train/commands.h"
#include "train/common_flags.h"
#include "train/evaluation/evaluation.h"
#include "train/progress_bar.h"
#include "train/train_flags.h"
#include "train/trainer/trainer.h"

ABSL_FLAG(bool, resume, false, "train: go on from the checkpoint in --out, if there is one");
ABSL_FLAG(int, checkpoint_every, 100, "train: iterations between checkpoints");
ABSL_FLAG(int, validate_every, 50, "train: iterations between validation losses");

namespace spikeserve {
namespace {

absl::Status CheckInterval(absl::string_view flag, int value) {
  if (value >= 1) return absl::OkStatus();
  return absl::InvalidArgumentError(absl::StrCat(flag, ": expected at least 1, received ", value));
}

// Trains to the end. Returns the last validation loss, or -1 without validation data.
absl::StatusOr<double> TrainToEnd(const std::string& checkpoint, Trainer* trainer, int iterations) {
  constexpr double kForget = 0.05;  // of the running mean of the loss that is shown
  ProgressBar progress(iterations, trainer->iteration());
  double shown_loss = -1.0;
  double validation = -1.0;
  while (!trainer->done()) {
    const Trainer::StepReport step = trainer->Step();
    shown_loss = shown_loss < 0.0 ? step.loss : shown_loss + kForget * (step.loss - shown_loss);
    const int iteration = trainer->iteration();
    if (!std::isfinite(step.loss)) {
      return absl::InternalError(absl::StrCat("the loss is not finite at iteration ", iteration,
                                              "; try a lower --learning_rate"));
    }
    const bool last = trainer->done();
    if (trainer->has_validation() &&
        (last || iteration % absl::GetFlag(FLAGS_validate_every) == 0)) {
      validation = trainer->ValidationLoss();
    }
    if (last || iteration % absl::GetFlag(FLAGS_checkpoint_every) == 0) {
      if (auto status = trainer->SaveCheckpoint(checkpoint); !status.ok()) return status;
    }
    progress.Update(iteration, absl::StrFormat("loss %.4f, validation %.4f, excess rate %.4f",
                                               shown_loss, validation, step.hinge));
  }
  return validation;
}

// Plays the policy where its environment is ours; nothing otherwise.
absl::StatusOr<absl::optional<Evaluation>> EvaluateIfPossible(const Policy& policy,
                                                              const EvaluationOptions& options) {
  if (!MakeEnvironment(policy.environment).ok()) return absl::optional<Evaluation>();
  absl::StatusOr<Evaluation> evaluation = Evaluate(std::make_shared<const Policy>(policy), options);
  if (!evaluation.ok()) return evaluation.status();
  return absl::optional<Evaluation>(*std::move(evaluation));
}

// The record of how a policy came to be. `earlier` is that of the policy it started from, "{}" if
// from none.
std::string TrainingRecord(const std::string& command_line, const TrainOptions& options,
                           const Dataset& dataset, double validation,
                           const absl::optional<Evaluation>& evaluation, const ModelConfig& config,
                           const std::string& earlier) {
  nlohmann::ordered_json record = {
      {"command", command_line}, {"seed", options.seed}, {"data", dataset.recipe}};
  if (evaluation.has_value()) record["evaluation"] = ToJson(*evaluation, config);
  if (validation >= 0.0) record["validation_loss"] = validation;
  auto before = nlohmann::ordered_json::parse(earlier, nullptr, /*allow_exceptions=*/false);
  if (before.is_object() && !before.empty()) {
    record["lineage"] = before.value("lineage", nlohmann::ordered_json::array());
    before.erase("lineage");
    record["lineage"].push_back(std::move(before));
  }
  return record.dump();
}

absl::Status MakeDirectory(const std::string& path) {
  std::error_code error;
  std::filesystem::create_directories(path, error);
  if (!error) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("out: cannot make the directory ", path, ": ", error.message()));
}

}  // namespace

absl::Status TrainCommand(const std::string& command_line) {
  const absl::StatusOr<std::string> out = RequiredOut("the directory to write into");
  if (!out.ok()) return out.status();
  const absl::StatusOr<TrainOptions> options = TrainOptionsFromFlags();
  if (!options.ok()) return options.status();
  const EvaluationOptions evaluation_options = {.episodes = absl::GetFlag(FLAGS_episodes)};
  for (const absl::Status& status :
       {evaluation_options.Validate(),
        CheckInterval("checkpoint_every", absl::GetFlag(FLAGS_checkpoint_every)),
        CheckInterval("validate_every", absl::GetFlag(FLAGS_validate_every)),
        MakeDirectory(*out)}) {
    if (!status.ok()) return status;
  }
  const absl::StatusOr<Dataset> dataset = DatasetFromFlags();
  if (!dataset.ok()) return dataset.status();
  const absl::StatusOr<Policy> initial = InitialPolicyFromFlags(*dataset);
  if (!initial.ok()) return initial.status();

  Trainer trainer(*initial, *dataset, *options);
  const std::string checkpoint = absl::StrCat(*out, "/checkpoint.pt");
  if (absl::GetFlag(FLAGS_resume) && std::filesystem::exists(checkpoint)) {
    if (auto status = trainer.LoadCheckpoint(checkpoint); !status.ok()) return status;
  }
  const absl::StatusOr<double> validation = TrainToEnd(checkpoint, &trainer, options->iterations);
  if (!validation.ok()) return validation.status();

  Policy policy = trainer.CurrentPolicy();
  const absl::StatusOr<absl::optional<Evaluation>> evaluation =
      EvaluateIfPossible(policy, evaluation_options);
  if (!evaluation.ok()) return evaluation.status();
  policy.training = TrainingRecord(command_line, *options, *dataset, *validation, *evaluation,
                                   policy.config, initial->training);
  if (auto status = WritePolicyFile(policy, absl::StrCat(*out, "/policy.safetensors"));
      !status.ok()) {
    return status;
  }
  if (evaluation->has_value()) PrintEvaluation(**evaluation, policy.config);
  return absl::OkStatus();
}

}  // namespace spikeserve
