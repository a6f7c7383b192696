#include "train/train_run.h"

#include <cmath>
#include <filesystem>
#include <memory>
#include <system_error>
#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_split.h"
#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/dataset/policy_description.h"
#include "core/environment/environment.h"
#include "core/model/policy_file.h"
#include "core/model/wiring_fit.h"
#include "core/model/wiring_model.h"
#include "train/baselines/comparison.h"
#include "train/baselines/verdict.h"
#include "train/data/clip_sampler.h"
#include "train/evaluation/evaluation.h"
#include "train/evaluation/training_record.h"
#include "train/model/torch_model.h"
#include "train/progress_bar.h"
#include "train/recording/policy_player.h"
#include "train/trainer/activity_router.h"
#include "train/trainer/device.h"
#include "train/trainer/initial_policy.h"
#include "train/trainer/lookback.h"
#include "train/trainer/return_scaling.h"
#include "train/trainer/trainer.h"

namespace spikeserve {

const char kLossAdvice[] = "train with more --iterations and --overwrite";

namespace {

// The validation losses of a run, by iteration; none without validation data.
using ValidationLosses = std::vector<std::pair<int, double>>;

// Writes the losses of a run to OUT/learning_curve.csv. A run that continues keeps the rows up to
// its checkpoint, and is judged by their validation losses, too.
class LearningCurve {
 public:
  LearningCurve(const TrainFlags& flags, int iteration)
      : path_(flags.out + "/learning_curve.csv"), text_(kHeader) {
    if (iteration == 0) return;
    const absl::StatusOr<std::string> earlier = ReadFile(path_);
    if (!earlier.ok()) return;
    for (const absl::string_view row : absl::StrSplit(*earlier, '\n', absl::SkipEmpty())) {
      const std::vector<absl::string_view> cells = absl::StrSplit(row, ',');
      int of_row = 0;
      double validation = 0.0;
      if (cells.size() != 3 || !absl::SimpleAtoi(cells[0], &of_row) || of_row > iteration ||
          !absl::SimpleAtod(cells[2], &validation)) {
        continue;
      }
      absl::StrAppend(&text_, row, "\n");
      losses_.emplace_back(of_row, validation);
    }
  }

  absl::Status Add(int iteration, double loss, double validation) {
    losses_.emplace_back(iteration, validation);
    // All digits, so that a run that continues is judged as one that was not interrupted.
    absl::StrAppendFormat(&text_, "%d,%.6g,%.17g\n", iteration, loss, validation);
    return WriteFileAtomically(path_, {text_});
  }

  const ValidationLosses& losses() const { return losses_; }

 private:
  static constexpr char kHeader[] = "iteration,loss,validation_loss\n";
  const std::string path_;
  std::string text_;
  ValidationLosses losses_;
};

// Removes what another run in --out has written beside its policy, of which this one may write
// nothing.
void RemoveOtherResults(const TrainFlags& flags) {
  std::error_code ignored;
  for (const char* name : {"/learning_curve.csv", "/baselines.json"}) {
    std::filesystem::remove(flags.out + name, ignored);
  }
}

std::string ArithmeticFlag(const TrainFlags& flags) {
  return absl::StrCat("--arithmetic=", std::string(ToString(flags.trainer.options.arithmetic)));
}

// Trains to the end.
absl::StatusOr<ValidationLosses> TrainToEnd(const TrainFlags& flags, const std::string& checkpoint,
                                            Trainer* trainer) {
  ProgressBar progress(flags.trainer.options.iterations, trainer->iteration());
  LearningCurve curve(flags, trainer->iteration());
  while (!trainer->done()) {
    RETURN_IF_ERROR(trainer->ReadEpisodes());
    const absl::StatusOr<Trainer::StepReport> step = trainer->Step();
    const int iteration = trainer->iteration();
    if (!step.ok()) {
      return Annotate(step.status(),
                      absl::StrCat(ArithmeticFlag(flags), ": iteration ", iteration));
    }
    if (!std::isfinite(step->loss)) {
      return absl::InternalError(absl::StrCat("the loss is not finite at iteration ", iteration,
                                              "; try a lower --learning_rate"));
    }
    const bool last = trainer->done();
    if (trainer->has_validation() && (last || iteration % flags.validate_every == 0)) {
      RETURN_IF_ERROR(curve.Add(iteration, step->mean_loss, trainer->ValidationLoss()));
    }
    if (last || iteration % flags.checkpoint_every == 0) {
      RETURN_IF_ERROR(trainer->SaveCheckpoint(checkpoint));
    }
    const std::string held_out =
        curve.losses().empty() ? ""
                               : absl::StrFormat(", validation %.4f", curve.losses().back().second);
    progress.Update(iteration, absl::StrFormat("loss %.4f%s, excess rate %.4f", step->mean_loss,
                                               held_out, step->hinge));
  }
  ValidationLosses losses = curve.losses();
  // A run that was resumed after its last iteration may lack the row.
  if (trainer->has_validation() && (losses.empty() || losses.back().first < trainer->iteration())) {
    RETURN_IF_ERROR(trainer->ReadEpisodes());
    losses.emplace_back(trainer->iteration(), trainer->ValidationLoss());
  }
  return losses;
}

// Evaluates the policy, or returns nothing if its environment is not one of this program.
absl::StatusOr<std::optional<Evaluation>> EvaluateIfPossible(const Policy& policy,
                                                             const EvaluationOptions& options) {
  if (!MakeEnvironment(policy.environment).ok()) return std::optional<Evaluation>();
  ASSIGN_OR_RETURN(Evaluation evaluation,
                   Evaluate(std::make_shared<const Policy>(policy), options));
  return std::optional<Evaluation>(std::move(evaluation));
}

// Returns the record of a policy's training. `sources` is the result of IdentifySources(),
// `earlier` the record of the initial policy, or "{}" if there is none.
std::string TrainingRecord(const std::string& command_line, const nlohmann::ordered_json& sources,
                           const TrainOptions& options, const Dataset& dataset, double validation,
                           const std::optional<Evaluation>& evaluation,
                           const std::optional<RoundingLoss>& loss, const ModelConfig& config,
                           const std::string& earlier) {
  nlohmann::ordered_json record = {{"command", command_line}};
  record.update(sources);
  record["seed"] = options.seed;
  record["data"] = dataset.recipe;
  if (loss.has_value()) record["rounding_loss"] = ToJson(*loss);
  if (evaluation.has_value()) record["evaluation"] = ToJson(*evaluation, config);
  if (validation >= 0.0) record["validation_loss"] = validation;
  AddLineage(earlier, &record);
  return record.dump();
}

// Returns the value of --observation_changes for a new policy: that of the flag, or by the data.
absl::StatusOr<bool> ChangesOf(const TrainFlags& flags, const EpisodeSource& source,
                               const PatchShape& patches) {
  const std::optional<bool> flag = flags.shape.observation_changes;
  if (patches.used() && flag.value_or(false)) {
    return InvalidArgument("--observation_changes", "false beside --patch_size", "true");
  }
  if (flag.has_value()) return *flag;
  if (patches.used() || source.dataset().observation_size > kMostBaselineInputs) return false;
  ASSIGN_OR_RETURN(const BaselineData data,
                   ReadBaselineData(source, flags.trainer.options.validation));
  return NeedsChanges(source.dataset().action_space, data.training);
}

absl::StatusOr<Policy> NewPolicy(const TrainFlags& flags, const EpisodeSource& source,
                                 const PatchShape& patches) {
  ModelConfig config;
  RETURN_IF_ERROR(SetShape(flags.shape, &config));
  ASSIGN_OR_RETURN(config.observation_changes, ChangesOf(flags, source, patches));
  Policy policy = InitialPolicy(config, source, flags.trainer.options.seed, patches);
  policy.return_offset = static_cast<float>(flags.return_offset.value_or(policy.return_offset));
  policy.return_scale = static_cast<float>(flags.return_scale.value_or(policy.return_scale));
  if (flags.lookback.has_value() && flags.mirror.has_value()) {
    return absl::InvalidArgumentError("--mirror: expected no such flag beside --lookback");
  }
  if (flags.lookback.has_value()) RETURN_IF_ERROR(LookBack(*flags.lookback, &policy));
  if (flags.mirror.has_value()) RETURN_IF_ERROR(Mirror(*flags.mirror, &policy));
  if (flags.activity_router) RETURN_IF_ERROR(RouteByActivity(&policy));
  return policy;
}

// Returns INVALID_ARGUMENT if a flag for new policies contradicts the policy of --init.
absl::Status CheckGiven(absl::string_view flag, std::optional<double> value, float given) {
  if (!value.has_value() || static_cast<float>(*value) == given) return absl::OkStatus();
  return InvalidArgument(flag, absl::StrCat("what --init has, ", given, ", or no such flag"),
                         *value);
}

absl::StatusOr<Policy> GivenPolicy(const TrainFlags& flags, const Dataset& dataset) {
  ASSIGN_OR_RETURN(Policy policy, ReadPolicyFile(flags.init));
  if (policy.config.arithmetic != Arithmetic::kFloat32) {
    return InvalidArgument(
        "--init", "a policy in float32",
        absl::StrCat("one in ", std::string(ToString(policy.config.arithmetic))));
  }
  RETURN_IF_ERROR(ContinueShape(flags.shape, &policy.config));
  if (flags.lookback.has_value()) {
    return InvalidArgument("--lookback", "no such flag beside --init", *flags.lookback);
  }
  if (flags.mirror.has_value()) {
    return InvalidArgument("--mirror", "no such flag beside --init", *flags.mirror);
  }
  if (flags.activity_router) {
    return absl::InvalidArgumentError(
        "--activity_router: expected no such flag beside --init, but --freeze=routing.hidden");
  }
  RETURN_IF_ERROR(CheckGiven("--return_offset", flags.return_offset, policy.return_offset));
  RETURN_IF_ERROR(CheckGiven("--return_scale", flags.return_scale, policy.return_scale));
  if (policy.environment != dataset.environment) {
    return InvalidArgument("--init", absl::StrCat("a policy for ", dataset.environment),
                           absl::StrCat("one for \"", policy.environment, "\""));
  }
  RETURN_IF_ERROR(CheckSpacesMatch(policy, dataset));
  return policy;
}

absl::Status CheckReturns(const TrainFlags& flags) {
  for (const auto& [flag, value] : {std::pair("--target_return", flags.target_return),
                                    std::pair("--return_offset", flags.return_offset)}) {
    if (!std::isfinite(value.value_or(0.0)))
      return InvalidArgument(flag, "a finite number", *value);
  }
  const double scale = flags.return_scale.value_or(1.0);
  if (scale > 0.0 && std::isfinite(scale)) return absl::OkStatus();
  return InvalidArgument("--return_scale", "a number above 0", scale);
}

// Returns where the target return of the initial policy comes from.
TargetSource TargetSourceOf(const TrainFlags& flags, const Policy& initial) {
  if (flags.target_return.has_value()) return TargetSource::kFlag;
  if (!flags.init.empty()) return TargetSource::kInitialPolicy;
  return ReturnScalingOf(initial.environment).ok() ? TargetSource::kEnvironment
                                                   : TargetSource::kData;
}

// Returns the policy of --init, or a new one, with the target return of the flag.
absl::StatusOr<Policy> MakeInitialPolicy(const TrainFlags& flags, const EpisodeSource& source,
                                         const PatchShape& patches) {
  RETURN_IF_ERROR(CheckReturns(flags));
  absl::StatusOr<Policy> policy =
      flags.init.empty() ? NewPolicy(flags, source, patches) : GivenPolicy(flags, source.dataset());
  if (!policy.ok()) return policy;
  if (flags.target_return.has_value()) {
    policy->target_return = static_cast<float>(*flags.target_return);
  }
  const Arithmetic arithmetic = flags.trainer.options.arithmetic;
  if (arithmetic == Arithmetic::kInteger && policy->config.is_dense()) {
    return InvalidArgument(
        "--arithmetic=integer", "a mode with spikes",
        "dense; `spiketrain quantize --to=integer` converts a trained dense policy");
  }
  if (flags.trainer.options.norm == NormTraining::kFade &&
      (policy->config.is_dense() || !policy->config.has_norms())) {
    return InvalidArgument(
        "--norm",
        absl::StrCat("layer ",
                     policy->config.is_dense() ? "in mode dense" : "for a policy without norms"),
        "fade");
  }
  if (arithmetic == Arithmetic::kInteger && !policy->config.has_norms()) {
    return InvalidArgument(
        "--arithmetic=integer", "a policy with norms",
        "one without; `spiketrain quantize --to=integer` converts a trained one");
  }
  const absl::Status rounded = RoundTo(arithmetic, *policy).status();
  if (!rounded.ok()) return Annotate(rounded, ArithmeticFlag(flags));
  return policy;
}

// Returns the patches of the flags for images.
absl::StatusOr<PatchShape> PatchesOf(const TrainFlags& flags, int observation_size) {
  PatchShape shape;
  if (flags.patch_size == 0 && flags.image_shape.empty()) return shape;
  if (!flags.init.empty()) {
    return absl::InvalidArgumentError(
        "--image_shape, --patch_size: expected no such flags beside --init, whose embedding is a "
        "matrix over all pixels");
  }
  shape.size = flags.patch_size;
  shape.features = flags.patch_features;
  int* const fields[] = {&shape.height, &shape.width, &shape.channels};
  for (size_t i = 0; i < 3 && flags.image_shape.size() == 3; ++i) {
    if (!absl::SimpleAtoi(flags.image_shape[i], fields[i])) *fields[i] = 0;
  }
  RETURN_IF_ERROR(shape.Validate(observation_size));
  return shape;
}

// Compares the policy with baselines on the same data and starts, and writes them to --out. Returns
// nothing with --no_baselines, and for observations that are too large.
absl::StatusOr<std::optional<BaselineComparison>> CompareIfPossible(
    const TrainFlags& flags, const EpisodeSource& source, const Policy& policy,
    const std::optional<Evaluation>& evaluation) {
  if (flags.no_baselines || policy.observation_size() > kMostBaselineInputs) {
    return std::optional<BaselineComparison>();
  }
  const TrainOptions& options = flags.trainer.options;
  ASSIGN_OR_RETURN(const BaselineData data, ReadBaselineData(source, options.validation));
  BaselineComparison comparison =
      CompareWithBaselines(std::make_shared<const Policy>(policy), data, options.seed);
  if (evaluation.has_value()) {
    RETURN_IF_ERROR(PlayBaselines(policy.environment, evaluation->options.first_seed,
                                  evaluation->returns, &comparison));
  }
  const std::string text = ToJson(comparison, /*with_weights=*/true).dump() + "\n";
  if (auto status = WriteFileAtomically(flags.out + "/baselines.json", {text}); !status.ok()) {
    return status;
  }
  return std::optional<BaselineComparison>(std::move(comparison));
}

// Adds what the data say about the robot. Robots that act late differ from the data's steps.
void Describe(const TrainOptions& options, const EpisodeSource& source, Policy* policy) {
  AddNames(source.dataset().recipe, policy);
  const auto size = static_cast<size_t>(source.dataset().observation_size);
  if (options.delay.most > 0 || size > WiringModel::kMostElements) return;
  std::vector<int> first;
  size_t steps = 0;
  for (const EpisodeEntry& entry : source.entries()) {
    if (steps >= WiringFit::kMostSteps) break;
    steps += static_cast<size_t>(entry.steps);
    first.push_back(static_cast<int>(first.size()));
  }
  const auto episodes = source.Read(first);
  if (episodes.ok()) AddWiringModel(*episodes, policy).IgnoreError();  // too few steps
}

// Measures what integers lost of what the float32 policy of --init returns on the same starts, or
// agrees with in the episodes that are held out. Nothing in other trainings.
absl::StatusOr<std::optional<RoundingLoss>> MeasureLoss(
    const TrainOptions& options, const EpisodeSource& source, const Policy& initial,
    const Policy& policy, const std::optional<Evaluation>& evaluation) {
  if (evaluation.has_value()) {
    ASSIGN_OR_RETURN(Evaluation before,
                     Evaluate(std::make_shared<const Policy>(initial), evaluation->options));
    ASSIGN_OR_RETURN(const RoundingLoss loss,
                     LostReturn(initial, {.first = std::move(before), .second = *evaluation}));
    return std::optional<RoundingLoss>(loss);
  }
  const std::vector<int> held_out = SplitEpisodes(source.entries(), options.validation).validation;
  if (held_out.empty()) return std::optional<RoundingLoss>();
  ASSIGN_OR_RETURN(std::vector<Episode> episodes, source.Read(held_out));
  for (Episode& episode : episodes) episode.target_return = policy.target_return;
  return std::optional<RoundingLoss>(LostAgreement(initial, policy, episodes));
}

// Writes the policy to --out, evaluates it, and writes it again with the result in its record.
absl::StatusOr<TrainedPolicy> Finish(const TrainFlags& flags, const std::string& command_line,
                                     const nlohmann::ordered_json& sources,
                                     const TrainOptions& options, const EpisodeSource& source,
                                     const Policy& initial, const ValidationLosses& losses,
                                     Policy policy) {
  const double validation = losses.empty() ? -1.0 : losses.back().second;
  const std::string path = absl::StrCat(flags.out, "/policy.safetensors");
  Describe(options, source, &policy);
  const auto record = [&](const std::optional<Evaluation>& evaluation,
                          const std::optional<RoundingLoss>& loss) {
    policy.training = TrainingRecord(command_line, sources, options, source.dataset(), validation,
                                     evaluation, loss, policy.config, initial.training);
    return WritePolicyFile(policy, path);
  };
  const bool may_lose = policy.config.is_integer() && !flags.init.empty();
  // Whatever fails below only reports, except a loss that is too large.
  if (!may_lose) RETURN_IF_ERROR(record(std::nullopt, std::nullopt));
  ASSIGN_OR_RETURN(
      const std::optional<Evaluation> evaluation,
      EvaluateIfPossible(policy, {.episodes = flags.episodes, .delay = options.delay}));
  std::optional<RoundingLoss> loss;
  if (may_lose) {
    ASSIGN_OR_RETURN(loss, MeasureLoss(options, source, initial, policy, evaluation));
    if (loss.has_value()) RETURN_IF_ERROR(flags.gate.Check(*loss, kLossAdvice));
  }
  RETURN_IF_ERROR(record(evaluation, loss));
  absl::StatusOr<std::optional<BaselineComparison>> comparison =
      std::optional<BaselineComparison>();
  // With a delay a baseline would imitate other labels and play another task.
  if (options.delay.most == 0) comparison = CompareIfPossible(flags, source, policy, evaluation);
  if (!comparison.ok()) return comparison.status();
  ASSIGN_OR_RETURN(const double spikes_on_data,
                   evaluation.has_value() ? 0.0 : SpikesOnData(policy, source));
  TrainSummary summary = {
      .path = path,
      .target_source = TargetSourceOf(flags, initial),
      .validation_loss = validation,
      .evaluation = evaluation,
      .loss = loss,
      .spikes_on_data = spikes_on_data,
      .verdict = Judge(*comparison, ActionNames(source.dataset()), LossFall(losses)),
      .comparison = *std::move(comparison)};
  return TrainedPolicy{.policy = std::move(policy), .summary = std::move(summary)};
}

// Returns the words that identify, in the checkpoints of a run, how its attention starts.
std::string StartWords(const TrainFlags& flags) {
  std::string words;
  if (flags.lookback.has_value()) absl::StrAppend(&words, " --lookback=", *flags.lookback);
  if (flags.mirror.has_value()) absl::StrAppend(&words, " --mirror=", *flags.mirror);
  return words;
}

}  // namespace

absl::Status CheckOut(const TrainFlags& flags) {
  if (flags.overwrite && flags.resume) {
    return absl::InvalidArgumentError("--overwrite: expected no such flag beside --resume");
  }
  if (flags.overwrite) return absl::OkStatus();
  const std::string checkpoint = flags.out + "/checkpoint.pt";
  const std::string policy = flags.out + "/policy.safetensors";
  const bool has_checkpoint = std::filesystem::exists(checkpoint);
  if (has_checkpoint && flags.resume) return absl::OkStatus();
  if (!has_checkpoint && !std::filesystem::exists(policy)) return absl::OkStatus();
  return InvalidArgument(
      "--out",
      absl::StrCat("another directory, ", has_checkpoint ? "--resume to continue the run, " : "",
                   "or --overwrite to replace it"),
      absl::StrCat("one with ", has_checkpoint ? checkpoint : policy));
}

absl::StatusOr<TrainedPolicy> TrainPolicy(const TrainFlags& flags, const EpisodeSource& source,
                                          const std::string& command_line) {
  ASSIGN_OR_RETURN(TrainOptions options, MakeTrainOptions(flags.trainer));
  ASSIGN_OR_RETURN(options.patches, PatchesOf(flags, source.dataset().observation_size));
  RETURN_IF_ERROR(CheckSource(options, source));
  RETURN_IF_ERROR(CheckOut(flags));
  RETURN_IF_ERROR(MakeOutDirectory(flags.out));
  ASSIGN_OR_RETURN(const Policy initial, MakeInitialPolicy(flags, source, options.patches));
  RETURN_IF_ERROR(CheckFrozen(options.frozen, initial));
  RETURN_IF_ERROR(CheckDevice(options.device, options.arithmetic));
  if (flags.activity_router) options.frozen.emplace_back(kActivityRouterTensors);
  ASSIGN_OR_RETURN(const nlohmann::ordered_json sources, IdentifySources(flags.init, flags.data));

  AdviseOnKernels();
  Trainer trainer(initial, source, options, StartWords(flags) + SourceWords(sources));
  const std::string checkpoint = absl::StrCat(flags.out, "/checkpoint.pt");
  if (flags.resume && std::filesystem::exists(checkpoint)) {
    RETURN_IF_ERROR(trainer.LoadCheckpoint(checkpoint));
  }
  if (trainer.iteration() == 0) RemoveOtherResults(flags);
  ASSIGN_OR_RETURN(const ValidationLosses losses, TrainToEnd(flags, checkpoint, &trainer));
  return Finish(flags, command_line, sources, options, source, initial, losses,
                trainer.CurrentPolicy());
}

}  // namespace spikeserve
