#include "train/trainer/trainer.h"

#include <torch/nn/utils/clip_grad.h>
#include <torch/optim/adamw.h>
#include <torch/serialize.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <iterator>
#include <numbers>
#include <numeric>
#include <utility>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_replace.h"
#include "absl/strings/str_split.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/math/counter_random.h"
#include "core/model/policy_metadata.h"
#include "train/trainer/device.h"
#include "train/trainer/initial_policy.h"

namespace spikeserve {
namespace {

// First part of every key of the counter-based generator.
enum Stream : uint64_t { kTrainingClips = 11, kValidationClips = 12 };

constexpr double kPhaseRateFactor = 0.3;   // learning rate of omega and phi, relative to the others
constexpr double kFinalRateFactor = 0.02;  // final learning rate, relative to the peak
constexpr double kHingeRamp = 1.0 / 3.0;   // share of the iterations in which the penalty grows
constexpr double kFade = 0.7;              // share of the iterations in which norms fade
constexpr int kValidationBatches = 4;
constexpr double kForget = 0.05;  // weight of the newest loss in the running mean

absl::Status Require(bool holds, absl::string_view option, absl::string_view expected,
                     double received) {
  if (holds) return absl::OkStatus();
  return InvalidArgument(option, expected, received);
}

template <typename T>
torch::Tensor Copy(const std::vector<T>& values, std::vector<int64_t> shape,
                   torch::ScalarType type) {
  return torch::from_blob(const_cast<T*>(values.data()), shape, type).clone();
}

// Returns the name of a tensor in a torch archive, which does not allow dots in names.
std::string ArchiveName(const std::string& name) { return absl::StrReplaceAll(name, {{".", "/"}}); }

// Returns whether `name` is `part`, or has it between two dots, its beginning or its end.
bool HasPart(absl::string_view name, absl::string_view part) {
  return absl::StrContains(absl::StrCat(".", name, "."), absl::StrCat(".", part, "."));
}

bool IsFrozen(const std::string& name, const std::vector<std::string>& frozen) {
  return std::any_of(frozen.begin(), frozen.end(),
                     [&](const std::string& part) { return HasPart(name, part); });
}

ClipShape ShapeOfClips(const TrainOptions& options, const ModelConfig& config) {
  return {.timesteps = options.clip_steps == 0 ? config.context : options.clip_steps,
          .padding = options.padding,
          .delay = options.delay};
}

// Returns the text that identifies the options and the data of a run in its checkpoints.
std::string RunText(const TrainOptions& options, const EpisodeSource& source) {
  const std::string text =
      absl::StrCat(options.ToFlags(), " data=", source.dataset().recipe.dump());
  // The chunks of other runs hold other episodes.
  return source.resident() ? text : absl::StrCat(text, " data_memory=", source.memory());
}

// Returns the text that identifies the initial policy, of which the tensors do not show all, and
// the files that the run reads.
std::string OriginText(const Policy& initial, const std::string& sources) {
  std::map<std::string, std::string> metadata = FormatPolicyMetadata(initial);
  const std::string config = absl::StrReplaceAll(
      metadata["config"], {{"{", ""}, {"}", ""}, {"\"", ""}, {":", "="}, {",", " "}});
  return absl::StrCat("environment=", initial.environment, " ", config,
                      " return_offset=", metadata["return_offset"],
                      " return_scale=", metadata["return_scale"], sources);
}

// Returns FAILED_PRECONDITION with the words that differ, unless both texts are equal.
absl::Status CheckSame(const std::string& path, const std::string& expected,
                       const std::string& received) {
  if (expected == received) return absl::OkStatus();
  const auto only = [](const std::string& text, const std::string& other) {
    const std::vector<std::string> words = absl::StrSplit(text, ' ');
    const std::vector<std::string> others = absl::StrSplit(other, ' ');
    std::vector<std::string> found;
    std::copy_if(words.begin(), words.end(), std::back_inserter(found), [&](const auto& word) {
      return std::find(others.begin(), others.end(), word) == others.end();
    });
    return found.empty() ? "none" : absl::StrJoin(found, " ");
  };
  return absl::FailedPreconditionError(absl::StrCat(path, ": to continue its run, expected ",
                                                    only(expected, received), ", received ",
                                                    only(received, expected)));
}

}  // namespace

absl::Status TrainOptions::Validate() const {
  absl::Status status;
  const auto check = [&](bool holds, absl::string_view option, absl::string_view expected,
                         double received) {
    if (status.ok()) status = Require(holds, option, expected, received);
  };
  check(iterations >= 1, "iterations", "at least 1", iterations);
  check(batch >= 1, "batch", "at least 1", batch);
  check(clip_steps >= 0, "clip_steps", "0 or more", clip_steps);
  check(learning_rate > 0.0, "learning_rate", "a number above 0", learning_rate);
  check(weight_decay >= 0.0, "weight_decay", "0 or more", weight_decay);
  check(warmup >= 0, "warmup", "0 or more", warmup);
  check(clip_norm > 0.0, "clip_norm", "a number above 0", clip_norm);
  check(action_noise >= 0.0 && action_noise <= 1.0, "action_noise", "0 to 1", action_noise);
  check(delay.least >= 0 && delay.least <= delay.most, "delay", "steps from the least to the most",
        delay.least);
  check(validation >= 0.0 && validation < 1.0, "validation", "0 or more, below 1", validation);
  check(rate_targets.hidden >= 0.0 && rate_targets.hidden <= 1.0, "target_rate", "0 to 100 percent",
        100.0 * rate_targets.hidden);
  check(rate_targets.readout >= 0.0 && rate_targets.readout <= 1.0, "readout_rate",
        "0 to 100 percent", 100.0 * rate_targets.readout);
  check(spike_penalty >= 0.0, "spike_penalty", "0 or more", spike_penalty);
  check(operation_penalty >= 0.0, "operation_penalty", "0 or more", operation_penalty);
  check(threads >= 1, "threads", "at least 1", threads);
  check(surrogate.slope > 0.0f, "slope", "a number above 0", surrogate.slope);
  check(plasticity.rate >= 0.0, "local_rate", "0 or more", plasticity.rate);
  check(plasticity.trace_decay >= 0.0 && plasticity.trace_decay <= 1.0, "trace_decay", "0 to 1",
        plasticity.trace_decay);
  if (status.ok() && plasticity.rule == Rule::kCorrections) {
    return InvalidArgument("local_rule", "a rule that learns from rewards", "corrections");
  }
  if (status.ok() && norm == NormTraining::kFade && arithmetic != Arithmetic::kFloat32) {
    return InvalidArgument(
        "norm", absl::StrCat("layer with arithmetic ", std::string(ToString(arithmetic))), "fade");
  }
  return status;
}

std::string TrainOptions::ToFlags() const {
  const std::string surrogate_name(ToString(surrogate.kind));
  std::string flags = absl::StrFormat(
      "--seed=%d --iterations=%d --batch=%d --clip_steps=%d --learning_rate=%g --weight_decay=%g "
      "--warmup=%d --clip_norm=%g --action_noise=%g --validation=%g --target_rate=%g "
      "--readout_rate=%g --spike_penalty=%g --operation_penalty=%g --surrogate=%s "
      "--slope=%g",
      seed, iterations, batch, clip_steps, learning_rate, weight_decay, warmup, clip_norm,
      action_noise, validation, 100.0 * rate_targets.hidden, 100.0 * rate_targets.readout,
      spike_penalty, operation_penalty, surrogate_name, surrogate.slope);
  // Runs of programs without this flag stay the same runs.
  if (arithmetic != Arithmetic::kFloat32) {
    absl::StrAppend(&flags, " --arithmetic=", std::string(ToString(arithmetic)));
  }
  if (norm == NormTraining::kFade) absl::StrAppend(&flags, " --norm=fade");
  if (delay.most > 0) absl::StrAppendFormat(&flags, " --delay=%d..%d", delay.least, delay.most);
  if (patches.used()) {
    absl::StrAppendFormat(&flags, " --image_shape=%d,%d,%d --patch_size=%d --patch_features=%d",
                          patches.height, patches.width, patches.channels, patches.size,
                          patches.features);
  }
  if (plasticity.rate > 0.0) {
    absl::StrAppendFormat(&flags, " --local_rate=%g --local_rule=%s --trace_decay=%g",
                          plasticity.rate, std::string(ToString(plasticity.rule)),
                          plasticity.trace_decay);
  }
  if (padding != Padding::kEnd) {
    absl::StrAppend(&flags, " --padding=", std::string(ToString(padding)));
  }
  if (schedule != Schedule::kCosine) {
    absl::StrAppend(&flags, " --schedule=", std::string(ToString(schedule)));
  }
  if (threads != 1) absl::StrAppend(&flags, " --threads=", threads);
  if (!device.is_cpu()) absl::StrAppend(&flags, " --device=", device.str());
  if (!frozen.empty()) absl::StrAppend(&flags, " --freeze=", absl::StrJoin(frozen, ","));
  return flags;
}

absl::Status CheckFrozen(const std::vector<std::string>& frozen, const Policy& policy) {
  const auto tensors = CopyTensors(policy);
  for (const std::string& part : frozen) {
    const auto has_part = [&](const auto& tensor) { return HasPart(tensor.first, part); };
    if (std::any_of(tensors.begin(), tensors.end(), has_part)) continue;
    std::vector<std::string> names;
    for (const auto& [name, tensor] : tensors) names.push_back(name);
    return absl::InvalidArgumentError(
        absl::StrCat("--freeze: expected tensors of the policy, by name or by parts of it between "
                     "dots: ",
                     absl::StrJoin(names, ", "), "; received ", part));
  }
  return absl::OkStatus();
}

// AdamW with two parameter groups: the phase generators, with a learning rate of their own and no
// weight decay, and all other parameters.
struct Trainer::Optimizer {
  static std::unique_ptr<Optimizer> Make(const Parameters& parameters,
                                         const TrainOptions& options) {
    std::vector<torch::Tensor> rest, phase;
    for (const auto& [name, tensor] : parameters.tensors()) {
      if (!tensor.requires_grad() || IsFrozen(name, options.frozen)) continue;
      (absl::StartsWith(name, "phase.") ? phase : rest).push_back(tensor);
    }
    using torch::optim::AdamWOptions;
    using torch::optim::OptimizerParamGroup;
    std::vector<OptimizerParamGroup> groups;
    groups.emplace_back(
        rest, std::make_unique<AdamWOptions>(
                  AdamWOptions(options.learning_rate).weight_decay(options.weight_decay)));
    if (!phase.empty()) {
      groups.emplace_back(phase, std::make_unique<AdamWOptions>(
                                     AdamWOptions(options.learning_rate).weight_decay(0.0)));
    }
    std::vector<torch::Tensor> all = rest;
    all.insert(all.end(), phase.begin(), phase.end());
    return std::make_unique<Optimizer>(
        Optimizer{torch::optim::AdamW(std::move(groups), AdamWOptions(options.learning_rate)),
                  std::move(all)});
  }

  torch::optim::AdamW adamw;
  std::vector<torch::Tensor> parameters;
};

Trainer::Trainer(Policy initial, const EpisodeSource& source, const TrainOptions& options,
                 const std::string& sources)
    : source_(source),
      options_(options),
      run_(RunText(options, source)),
      origin_(OriginText(initial, sources)),
      config_(initial.config),
      action_space_(source.dataset().action_space),
      observation_size_(source.dataset().observation_size),
      clip_(ShapeOfClips(options, initial.config)),
      split_(SplitEpisodes(source.entries(), options.validation)),
      spread_(torch::tensor(EncodedLabels(source).std).to(options.device)),
      model_(initial, options.surrogate, options.arithmetic, options.patches, options.seed,
             options.device),
      optimizer_(Optimizer::Make(model_.parameters(), options)) {
  UseThreads(options.threads);
  if (options.norm == NormTraining::kFade) model_.FadeNorms();
  if (source.resident()) {
    clips_ = std::make_unique<ClipSampler>(source.dataset(), split_.training, clip_);
    if (!has_validation()) return;
    const ClipSampler validation(source.dataset(), split_.validation, clip_);
    for (uint64_t i = 0; i < kValidationBatches; ++i) {
      validation_.push_back(validation.Sample(ValidationKey(i), options.batch, 0.0));
    }
    return;
  }
  plan_ = std::make_unique<ChunkPlan>(
      source.entries(), split_.training,
      ChunkPlan::Options{.memory = source.memory(),
                         .steps_per_iteration = int64_t{options.batch} * clip_.timesteps,
                         .seed = options.seed});
}

Trainer::~Trainer() = default;

absl::Status Trainer::ReadEpisodes() {
  if (source_.resident()) return absl::OkStatus();
  RETURN_IF_ERROR(ReadValidation());
  const bool held = clips_ != nullptr && iteration_ >= chunk_.begin && iteration_ < chunk_.end;
  if (held || done()) return absl::OkStatus();
  // Releases the last chunk before it reads the next one.
  clips_ = nullptr;
  resident_ = source_.dataset();
  chunk_ = plan_->At(iteration_);
  ASSIGN_OR_RETURN(resident_.episodes, source_.Read(chunk_.episodes));
  std::vector<int> all(resident_.episodes.size());
  std::iota(all.begin(), all.end(), 0);
  clips_ = std::make_unique<ClipSampler>(resident_, std::move(all), clip_);
  return absl::OkStatus();
}

absl::Status Trainer::ReadValidation() {
  if (!has_validation() || !validation_.empty()) return absl::OkStatus();
  std::vector<Clips> read;
  for (uint64_t i = 0; i < kValidationBatches; ++i) {
    ASSIGN_OR_RETURN(Clips clips, ReadClips(source_, split_.validation, clip_, ValidationKey(i),
                                            options_.batch));
    read.push_back(std::move(clips));
  }
  validation_ = std::move(read);
  return absl::OkStatus();
}

uint64_t Trainer::ValidationKey(uint64_t batch) const {
  return RandomBits({kValidationClips, options_.seed, batch});
}

Trainer::Batch Trainer::MakeBatch(const Clips& clips) const {
  const int64_t count = clips.count, n = clips.timesteps_per_clip, act = action_space_.size();
  const auto on_device = [this](const auto& values, std::vector<int64_t> shape,
                                torch::ScalarType type) {
    return Copy(values, std::move(shape), type).to(options_.device);
  };
  return {
      .clips = {.return_to_go = on_device(clips.return_to_go, {count, n}, torch::kFloat),
                .observations =
                    on_device(clips.observations, {count, n, observation_size_}, torch::kFloat),
                .actions = on_device(clips.actions, {count, n, act}, torch::kFloat),
                .timesteps = on_device(clips.timesteps, {count, n}, torch::kLong),
                .previous = on_device(clips.previous, {count, observation_size_}, torch::kFloat)},
      .targets = on_device(clips.targets, {count, n, act}, torch::kFloat),
      .mask = on_device(clips.mask, {count, n}, torch::kFloat),
      .weights = on_device(clips.weights, {count, n}, torch::kFloat)};
}

torch::Tensor Trainer::Loss(const Batch& batch, const ModelOutput& output) const {
  return ImitationLoss(action_space_, output.logits, batch.targets, batch.weights, spread_);
}

void Trainer::SetLearningRate() {
  const double warm =
      options_.warmup == 0 ? 1.0 : std::min(1.0, (iteration_ + 1.0) / options_.warmup);
  const int at = options_.schedule == Schedule::kConstant ? 0 : iteration_;
  const double cosine = 0.5 * (1.0 + std::cos(std::numbers::pi * at / options_.iterations));
  const double rate =
      options_.learning_rate * warm * (kFinalRateFactor + (1.0 - kFinalRateFactor) * cosine);
  auto& groups = optimizer_->adamw.param_groups();
  groups[0].options().set_lr(rate);
  if (groups.size() > 1) groups[1].options().set_lr(kPhaseRateFactor * rate);
}

void Trainer::SetNormShare() {
  if (model_.fading_norms() == nullptr) return;
  const double faded = iteration_ / (kFade * options_.iterations);
  model_.fading_norms()->set_share(std::max(0.0, 1.0 - faded));
}

void Trainer::LearnLocally(const Batch& batch, const ModelOutput& output) {
  if (options_.plasticity.rate == 0.0) return;
  const DataStatistics& statistics = source_.statistics();
  const torch::Tensor change = HeadChange(options_.plasticity, action_space_, output,
                                          {.return_to_go = batch.clips.return_to_go,
                                           .targets = batch.targets,
                                           .mask = batch.mask,
                                           .mean = statistics.return_mean(),
                                           .deviation = statistics.return_std()});
  const torch::NoGradGuard no_gradient;
  model_.parameters()["head.weight"].add_(change);
}

absl::StatusOr<Trainer::StepReport> Trainer::Step() {
  SPIKESERVE_DCHECK(!done());
  const uint64_t key =
      RandomBits({kTrainingClips, options_.seed, static_cast<uint64_t>(iteration_)});
  const Batch batch = MakeBatch(clips_->Sample(key, options_.batch, options_.action_noise));
  const ModelOutput output = model_.ForwardInTraining(batch.clips, batch.mask);
  torch::Tensor loss = Loss(batch, output);
  StepReport report = {.loss = loss.item<double>()};
  mean_loss_ = mean_loss_ < 0.0 ? report.loss : mean_loss_ + kForget * (report.loss - mean_loss_);
  report.mean_loss = mean_loss_;
  const double ramp = std::min(1.0, iteration_ / (kHingeRamp * options_.iterations));
  const torch::Tensor hinge = RateHinge(output.populations, options_.rate_targets, batch.mask);
  if (hinge.defined()) {
    report.hinge = hinge.item<double>();
    loss = loss + options_.spike_penalty * ramp * hinge;
  }
  if (options_.operation_penalty > 0.0) {
    const torch::Tensor share = OperationShare(output.populations, config_, batch.mask);
    if (share.defined()) loss = loss + options_.operation_penalty * ramp * share;
  }
  optimizer_->adamw.zero_grad();
  loss.backward();
  torch::nn::utils::clip_grad_norm_(optimizer_->parameters, options_.clip_norm);
  SetLearningRate();
  optimizer_->adamw.step();
  LearnLocally(batch, output);
  ++iteration_;
  SetNormShare();
  RETURN_IF_ERROR(model_.Round());
  return report;
}

double Trainer::ValidationLoss() const {
  SPIKESERVE_DCHECK(has_validation());
  const torch::NoGradGuard no_gradient;
  double sum = 0.0;
  int weighted = 0;
  for (uint64_t i = 0; i < kValidationBatches; ++i) {
    const std::vector<float>& weights = validation_[i].weights;
    if (std::all_of(weights.begin(), weights.end(), [](float w) { return w == 0.0f; })) continue;
    const Batch batch = MakeBatch(validation_[i]);
    sum += Loss(batch, model_.Forward(batch.clips)).item<double>();
    ++weighted;
  }
  return weighted == 0 ? -1.0 : sum / weighted;
}

std::map<std::string, torch::Tensor> Trainer::State() const {
  std::map<std::string, torch::Tensor> state = model_.parameters().tensors();
  if (const FadingNorms* norms = model_.fading_norms(); norms != nullptr) {
    state.merge(norms->tensors());
  }
  return state;
}

absl::Status Trainer::SaveCheckpoint(const std::string& path) const {
  const std::string temporary = path + ".tmp";
  try {
    torch::serialize::OutputArchive archive, optimizer;
    archive.write("run", c10::IValue(run_));
    archive.write("origin", c10::IValue(origin_));
    archive.write("iteration", c10::IValue(static_cast<int64_t>(iteration_)));
    archive.write("mean_loss", c10::IValue(mean_loss_));
    for (const auto& [name, tensor] : State()) {
      archive.write(ArchiveName(name), tensor);
    }
    optimizer_->adamw.save(optimizer);
    archive.write("optimizer", optimizer);
    archive.save_to(temporary);
    std::filesystem::rename(temporary, path);
  } catch (const std::exception&) {
    return absl::InternalError(absl::StrCat(path, ": cannot write"));
  }
  return absl::OkStatus();
}

absl::Status Trainer::LoadCheckpoint(const std::string& path) {
  if (!std::filesystem::exists(path)) {
    return absl::NotFoundError(absl::StrCat(path, ": no such file"));
  }
  try {
    torch::serialize::InputArchive archive, optimizer;
    archive.load_from(path);
    c10::IValue run, origin, iteration, mean_loss;
    archive.read("run", run);
    // Checkpoints of earlier programs lack the origin and the mean loss.
    const bool has_origin = archive.try_read("origin", origin);
    RETURN_IF_ERROR(
        has_origin ? CheckSame(path, absl::StrCat(run.toStringRef(), " ", origin.toStringRef()),
                               absl::StrCat(run_, " ", origin_))
                   : CheckSame(path, run.toStringRef(), run_));
    std::map<std::string, torch::Tensor> state = State();
    std::map<std::string, torch::Tensor> loaded;
    for (const auto& [name, tensor] : state) {
      archive.read(ArchiveName(name), loaded[name]);
      if (loaded[name].sizes() != tensor.sizes()) {
        return absl::FailedPreconditionError(absl::StrCat(path, ": ", name, " has another shape"));
      }
    }
    archive.read("optimizer", optimizer);
    optimizer_->adamw.load(optimizer);
    archive.read("iteration", iteration);
    const torch::NoGradGuard no_gradient;
    for (const auto& [name, tensor] : loaded) state[name].copy_(tensor);
    iteration_ = static_cast<int>(iteration.toInt());
    mean_loss_ = archive.try_read("mean_loss", mean_loss) ? mean_loss.toDouble() : -1.0;
    SetNormShare();
    return model_.Round();
  } catch (const c10::Error&) {
    return absl::FailedPreconditionError(absl::StrCat(path, ": not a checkpoint of this model"));
  }
}

}  // namespace spikeserve
