#include <cmath>
#include <cstdio>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <system_error>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/base/status.h"
#include "core/environment/environment.h"
#include "core/model/policy_file.h"
#include "core/model/quantize.h"
#include "train/commands.h"
#include "train/data/minari_layout.h"
#include "train/data/minari_reader.h"
#include "train/evaluation/evaluation.h"
#include "train/evaluation/training_record.h"
#include "train/progress_bar.h"
#include "train/record_flags.h"
#include "train/train_flags.h"
#include "train/train_summary.h"
#include "train/trainer/initial_policy.h"
#include "train/trainer/return_scaling.h"
#include "train/trainer/trainer.h"

namespace spikeserve {
namespace {

constexpr char kRecording[] = "Recording, without --data";

struct TrainFlags {
  std::string out;
  std::vector<std::string> data;   // none: record as `spiketrain dataset` would
  std::string init;                // initial policy file; empty: random weights
  std::optional<std::string> env;  // absent: that of the data, or CartPole-v1
  ShapeFlags shape;
  std::optional<double> target_return;  // absent: that of --init, the environment or the data
  std::optional<double> return_offset;  // absent: the default of the environment
  std::optional<double> return_scale;
  TrainerFlags trainer;
  RecordFlags record;
  int episodes = 100;  // of the evaluation at the end
  bool resume = false;
  int checkpoint_every = 100;
  int validate_every = 50;
  bool json = false;
};

absl::Status CheckCount(absl::string_view flag, int value) {
  if (value >= 1) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("--", flag, ": expected at least 1, received ", value));
}

// Trains to the end. Returns the last validation loss, or -1 without validation data.
absl::StatusOr<double> TrainToEnd(const TrainFlags& flags, const std::string& checkpoint,
                                  Trainer* trainer) {
  constexpr double kForget = 0.05;  // weight of the newest loss in the running mean that is shown
  ProgressBar progress(flags.trainer.options.iterations, trainer->iteration());
  double shown_loss = -1.0;
  double validation = -1.0;
  while (!trainer->done()) {
    const absl::StatusOr<Trainer::StepReport> step = trainer->Step();
    const int iteration = trainer->iteration();
    if (!step.ok()) {
      return Annotate(step.status(), absl::StrCat("--arithmetic=int8: iteration ", iteration));
    }
    shown_loss = shown_loss < 0.0 ? step->loss : shown_loss + kForget * (step->loss - shown_loss);
    if (!std::isfinite(step->loss)) {
      return absl::InternalError(absl::StrCat("the loss is not finite at iteration ", iteration,
                                              "; try a lower --learning_rate"));
    }
    const bool last = trainer->done();
    if (trainer->has_validation() && (last || iteration % flags.validate_every == 0)) {
      validation = trainer->ValidationLoss();
    }
    if (last || iteration % flags.checkpoint_every == 0) {
      if (auto status = trainer->SaveCheckpoint(checkpoint); !status.ok()) return status;
    }
    const std::string held_out =
        validation < 0.0 ? "" : absl::StrFormat(", validation %.4f", validation);
    progress.Update(iteration, absl::StrFormat("loss %.4f%s, excess rate %.4f", shown_loss,
                                               held_out, step->hinge));
  }
  // A run that was resumed after its last iteration has not validated yet.
  if (validation < 0.0 && trainer->has_validation()) validation = trainer->ValidationLoss();
  return validation;
}

// Evaluates the policy, or returns nothing if its environment is not one of this program.
absl::StatusOr<std::optional<Evaluation>> EvaluateIfPossible(const Policy& policy,
                                                             const EvaluationOptions& options) {
  if (!MakeEnvironment(policy.environment).ok()) return std::optional<Evaluation>();
  absl::StatusOr<Evaluation> evaluation = Evaluate(std::make_shared<const Policy>(policy), options);
  if (!evaluation.ok()) return evaluation.status();
  return std::optional<Evaluation>(*std::move(evaluation));
}

// Identifies the program and the files of --init and --data. Called before training, which may take
// long enough for the files to change.
absl::StatusOr<nlohmann::ordered_json> IdentifySources(const TrainFlags& flags) {
  nlohmann::ordered_json sources = {{"commit", BuildCommit()}};
  if (!flags.init.empty()) {
    const absl::StatusOr<std::string> sha256 = FileSha256(flags.init);
    if (!sha256.ok()) return sha256.status();
    sources["parent_sha256"] = *sha256;
  }
  for (const std::string& path : flags.data) {
    const absl::StatusOr<std::string> sha256 =
        FileSha256(IsMinariDataset(path) ? path + kMinariData : path);
    if (!sha256.ok()) return sha256.status();
    sources["data_sha256"][path] = *sha256;
  }
  return sources;
}

// Returns the record of a policy's training. `sources` is the result of IdentifySources(),
// `earlier` the record of the initial policy, or "{}" if there is none.
std::string TrainingRecord(const std::string& command_line, const nlohmann::ordered_json& sources,
                           const TrainOptions& options, const Dataset& dataset, double validation,
                           const std::optional<Evaluation>& evaluation, const ModelConfig& config,
                           const std::string& earlier) {
  nlohmann::ordered_json record = {{"command", command_line}};
  record.update(sources);
  record["seed"] = options.seed;
  record["data"] = dataset.recipe;
  if (evaluation.has_value()) record["evaluation"] = ToJson(*evaluation, config);
  if (validation >= 0.0) record["validation_loss"] = validation;
  AddLineage(earlier, &record);
  return record.dump();
}

absl::Status MakeDirectory(const std::string& path) {
  std::error_code error;
  std::filesystem::create_directories(path, error);
  if (!error) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("--out: cannot make the directory ", path, ": ", error.message()));
}

absl::StatusOr<Dataset> ReadData(const std::vector<std::string>& paths) {
  std::vector<Dataset> parts;
  for (const std::string& path : paths) {
    absl::StatusOr<Dataset> part =
        IsMinariDataset(path) ? ReadMinariDataset(path) : ReadDataset(path);
    if (!part.ok()) return part;
    parts.push_back(*std::move(part));
  }
  return Concatenate(std::move(parts));
}

// Reads the files of --data, or without that flag records data with the default recipe.
absl::StatusOr<Dataset> MakeDataset(const TrainFlags& flags) {
  if (flags.data.empty()) {
    RecordFlags record = flags.record;
    record.options.seed = flags.trainer.options.seed;
    record.options.expert.environment = flags.env.value_or(record.options.expert.environment);
    return RecordFromFlags(record, flags.out);
  }
  absl::StatusOr<Dataset> dataset = ReadData(flags.data);
  if (!dataset.ok()) return dataset;
  const std::string environment = flags.env.value_or(dataset->environment);
  if (environment != dataset->environment) {
    return absl::InvalidArgumentError(absl::StrCat("--env: expected ", dataset->environment,
                                                   " as in --data, received ", environment));
  }
  return dataset;
}

absl::StatusOr<Policy> NewPolicy(const TrainFlags& flags, const Dataset& dataset) {
  ModelConfig config;
  if (auto status = SetShape(flags.shape, &config); !status.ok()) return status;
  Policy policy = InitialPolicy(config, dataset, flags.trainer.options.seed);
  if (flags.return_offset.has_value()) {
    policy.return_offset = static_cast<float>(*flags.return_offset);
  }
  if (const auto scale = flags.return_scale; scale.has_value()) {
    if (!(*scale > 0.0) || !std::isfinite(*scale)) {
      return absl::InvalidArgumentError(
          absl::StrCat("--return_scale: expected a number above 0, received ", *scale));
    }
    policy.return_scale = static_cast<float>(*scale);
  }
  return policy;
}

absl::StatusOr<Policy> GivenPolicy(const TrainFlags& flags, const Dataset& dataset) {
  absl::StatusOr<Policy> policy = ReadPolicyFile(flags.init);
  if (!policy.ok()) return policy.status();
  if (policy->config.arithmetic != Arithmetic::kFloat32) {
    return absl::InvalidArgumentError("--init: expected a policy in float32, received one in int8");
  }
  if (auto status = CheckShape(flags.shape, policy->config); !status.ok()) return status;
  if (policy->environment != dataset.environment) {
    return absl::InvalidArgumentError(absl::StrCat("--init: expected a policy for ",
                                                   dataset.environment, ", received one for \"",
                                                   policy->environment, "\""));
  }
  return policy;
}

// Returns where the target return of the initial policy comes from.
TargetSource TargetSourceOf(const TrainFlags& flags, const Policy& initial) {
  if (flags.target_return.has_value()) return TargetSource::kFlag;
  if (!flags.init.empty()) return TargetSource::kInitialPolicy;
  return ReturnScalingOf(initial.environment).ok() ? TargetSource::kEnvironment
                                                   : TargetSource::kData;
}

// Returns the policy of --init, or a new one, with the target return of the flag.
absl::StatusOr<Policy> MakeInitialPolicy(const TrainFlags& flags, const Dataset& dataset) {
  if (flags.target_return.has_value() && !std::isfinite(*flags.target_return)) {
    return absl::InvalidArgumentError(
        absl::StrCat("--target_return: expected a finite number, received ", *flags.target_return));
  }
  absl::StatusOr<Policy> policy =
      flags.init.empty() ? NewPolicy(flags, dataset) : GivenPolicy(flags, dataset);
  if (!policy.ok()) return policy;
  if (flags.target_return.has_value()) {
    policy->target_return = static_cast<float>(*flags.target_return);
  }
  if (flags.trainer.options.arithmetic == Arithmetic::kInt8) {
    const absl::Status rounded = Quantize(*policy).status();
    if (!rounded.ok()) return Annotate(rounded, "--arithmetic=int8");
  }
  return policy;
}

// Writes policy.safetensors and prints the summary.
absl::Status Finish(const TrainFlags& flags, const std::string& command_line,
                    const nlohmann::ordered_json& sources, const TrainOptions& options,
                    const Dataset& dataset, const Policy& initial, double validation,
                    Policy policy) {
  const absl::StatusOr<std::optional<Evaluation>> evaluation =
      EvaluateIfPossible(policy, {.episodes = flags.episodes});
  if (!evaluation.ok()) return evaluation.status();
  policy.training = TrainingRecord(command_line, sources, options, dataset, validation, *evaluation,
                                   policy.config, initial.training);
  const std::string path = absl::StrCat(flags.out, "/policy.safetensors");
  if (auto status = WritePolicyFile(policy, path); !status.ok()) return status;
  const TrainSummary summary = {
      .path = path,
      .target_source = TargetSourceOf(flags, initial),
      .validation_loss = validation,
      .evaluation = *evaluation,
      .spikes_on_data = evaluation->has_value() ? 0.0 : SpikesOnData(policy, dataset)};
  std::fputs(
      (flags.json ? ToJson(summary, policy).dump(2) + "\n" : ToText(summary, policy)).c_str(),
      stdout);
  return absl::OkStatus();
}

absl::Status Train(const TrainFlags& flags, const std::string& command_line) {
  if (auto status = RequireOut(flags.out, "the directory to write into"); !status.ok()) {
    return status;
  }
  const absl::StatusOr<TrainOptions> options = MakeTrainOptions(flags.trainer);
  if (!options.ok()) return options.status();
  for (const absl::Status& status :
       {CheckCount("episodes", flags.episodes),
        CheckCount("checkpoint_every", flags.checkpoint_every),
        CheckCount("validate_every", flags.validate_every), MakeDirectory(flags.out)}) {
    if (!status.ok()) return status;
  }
  const absl::StatusOr<Dataset> dataset = MakeDataset(flags);
  if (!dataset.ok()) return dataset.status();
  const absl::StatusOr<Policy> initial = MakeInitialPolicy(flags, *dataset);
  if (!initial.ok()) return initial.status();

  const absl::StatusOr<nlohmann::ordered_json> sources = IdentifySources(flags);
  if (!sources.ok()) return sources.status();

  Trainer trainer(*initial, *dataset, *options);
  const std::string checkpoint = absl::StrCat(flags.out, "/checkpoint.pt");
  if (flags.resume && std::filesystem::exists(checkpoint)) {
    if (auto status = trainer.LoadCheckpoint(checkpoint); !status.ok()) return status;
  }
  const absl::StatusOr<double> validation = TrainToEnd(flags, checkpoint, &trainer);
  if (!validation.ok()) return validation.status();
  return Finish(flags, command_line, *sources, *options, *dataset, *initial, *validation,
                trainer.CurrentPolicy());
}

void AddFlags(Command command, TrainFlags* flags) {
  command.Flags("Training")
      .Add("out", "DIR", &flags->out, "Directory of the policy and the checkpoint")
      .AddList("data", "FILE,...", &flags->data, "Datasets; default: record one")
      .Add("init", "FILE", &flags->init, "Initial policy; default: random weights")
      .Add("env", "ID", &flags->env, "Environment; default: that of --data")
      .Add("seed", "N", &flags->trainer.options.seed, "Seed of every random draw")
      .AddSwitch("resume", &flags->resume, "Continue from the checkpoint in --out, if there is one")
      .Add("checkpoint_every", "N", &flags->checkpoint_every, "Iterations between checkpoints")
      .Add("validate_every", "N", &flags->validate_every, "Iterations between validations")
      .Add("episodes", "N", &flags->episodes, "Episodes of the evaluation at the end")
      .Add("target_return", "RETURN", &flags->target_return,
           "Return that the policy is asked for; default: by environment or data")
      .AddSwitch("json", &flags->json, "Print one JSON object instead of text");
  FlagGroup shape = command.Flags("Shape");
  AddModeFlag(shape, &flags->shape);
  AddShapeFlags(shape, &flags->shape);
  shape
      .Add("arithmetic", EnumKind<Arithmetic>(), &flags->trainer.options.arithmetic,
           "Numbers of the spike-driven parts")
      .Add("return_offset", "RETURN", &flags->return_offset,
           "Offset of the return token; default: by environment")
      .Add("return_scale", "RETURN", &flags->return_scale,
           "Scale of the return token; default: by environment");
  AddTrainerFlags(command, &flags->trainer);
  FlagGroup recording = command.Flags(kRecording);
  AddRecordFlags(recording, &flags->record);
  AddTablesFlag(recording, &flags->record.options.expert);
  command.RefuseBeside("data", kRecording);
}

}  // namespace

void AddTrainCommand(Program& program) {
  const Command command = program.root().AddCommand("train", "Trains a policy");
  const auto flags = std::make_shared<TrainFlags>();
  AddFlags(command, flags.get());
  command.SetAction([flags, &program] { return Train(*flags, program.CommandLine()); });
}

}  // namespace spikeserve
