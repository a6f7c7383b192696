#include "train/train_flags.h"

#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "absl/flags/flag.h"
#include "absl/strings/str_cat.h"
#include "absl/types/optional.h"
#include "core/model/policy_file.h"
#include "train/common_flags.h"
#include "train/data/minari_file.h"
#include "train/trainer/initial_policy.h"

using spikeserve::ModelConfig;
using spikeserve::TrainOptions;

ABSL_FLAG(std::vector<std::string>, data, {},
          "train: datasets, comma-separated: directories in Minari's layout or .cbor files "
          "(default: record "
          "one as `dataset` would)");
ABSL_FLAG(std::string, init, "", "train: a policy file to go on from (default: random weights)");

// The shape. Unset: that of --init, or of the paper.
ABSL_FLAG(absl::optional<std::string>, mode, absl::nullopt,
          "train: full (default), pos, route, baseline or dense");
ABSL_FLAG(absl::optional<int>, hidden_size, absl::nullopt, "train: d (default 128)");
ABSL_FLAG(absl::optional<int>, heads, absl::nullopt, "train: H (default 4)");
ABSL_FLAG(absl::optional<int>, layers, absl::nullopt, "train: L (default 2)");
ABSL_FLAG(absl::optional<int>, ticks, absl::nullopt, "train: T (default 10)");
ABSL_FLAG(absl::optional<int>, context, absl::nullopt, "train: N, in timesteps (default 20)");
ABSL_FLAG(absl::optional<int>, routing_hidden_size, absl::nullopt, "train: m (default 16)");
ABSL_FLAG(absl::optional<int>, ffn_size, absl::nullopt, "train: FFN size (default 4 d)");
ABSL_FLAG(absl::optional<std::string>, coder, absl::nullopt, "train: lif (default) or bernoulli");
ABSL_FLAG(absl::optional<std::string>, phase_clock, absl::nullopt,
          "train: timestep (default) or window");
ABSL_FLAG(absl::optional<std::string>, merge, absl::nullopt, "train: sum (default) or concat");
ABSL_FLAG(absl::optional<std::string>, gate, absl::nullopt, "train: softmax (default) or sigmoid");

// Unset: what suits the environment. Small numbers tell returns near the end of an episode apart.
ABSL_FLAG(absl::optional<double>, return_offset, absl::nullopt,
          "train: the return token's input is (G - return_offset) / return_scale");
ABSL_FLAG(absl::optional<double>, return_scale, absl::nullopt, "train: see --return_offset");

ABSL_FLAG(int, iterations, TrainOptions{}.iterations, "train: iterations");
ABSL_FLAG(int, batch, TrainOptions{}.batch, "train: clips an iteration");
ABSL_FLAG(int, clip_steps, TrainOptions{}.clip_steps,
          "train: timesteps of a clip; 0 for the policy's context. Where the present state tells "
          "everything, short clips teach the same in less time");
ABSL_FLAG(double, learning_rate, TrainOptions{}.learning_rate, "train: AdamW's peak learning rate");
ABSL_FLAG(double, weight_decay, TrainOptions{}.weight_decay, "train: AdamW's weight decay");
ABSL_FLAG(int, warmup, TrainOptions{}.warmup, "train: iterations of linear warm-up");
ABSL_FLAG(double, clip_norm, TrainOptions{}.clip_norm, "train: largest norm of the gradient");
ABSL_FLAG(double, action_noise, TrainOptions{}.action_noise,
          "train: probability that an action token is replaced by a random one");
ABSL_FLAG(double, validation, TrainOptions{}.validation,
          "train: share of each actor's episodes held out for the validation loss");
ABSL_FLAG(double, target_rate, 100.0,
          "train: percent of ticks above which a population's firing is penalised");
ABSL_FLAG(double, readout_rate, 100.0, "train: the same for the readout coder");
ABSL_FLAG(double, spike_penalty, TrainOptions{}.spike_penalty,
          "train: weight of that penalty, ramped in over the first third");
ABSL_FLAG(std::string, surrogate, "fast_sigmoid",
          "train: surrogate gradient: fast_sigmoid, sigmoid or piecewise_linear");
ABSL_FLAG(double, slope, static_cast<double>(TrainOptions{}.surrogate.slope),
          "train: slope k of the surrogate gradient");

namespace spikeserve {
namespace {

// Applies the flags of the shape to a config. With `fixed`, a flag may only repeat what is there.
class ShapeFlags {
 public:
  ShapeFlags(ModelConfig* config, bool fixed) : config_(*config), fixed_(fixed) {}

  absl::Status Apply() {
    SetEnum("mode", absl::GetFlag(FLAGS_mode), &config_.mode);
    Set("hidden_size", absl::GetFlag(FLAGS_hidden_size), Same, &config_.hidden_size);
    if (!fixed_) config_.ffn_size = 4 * config_.hidden_size;
    Set("heads", absl::GetFlag(FLAGS_heads), Same, &config_.heads);
    Set("layers", absl::GetFlag(FLAGS_layers), Same, &config_.layers);
    Set("ticks", absl::GetFlag(FLAGS_ticks), Same, &config_.ticks);
    Set("context", absl::GetFlag(FLAGS_context), Same, &config_.context);
    Set("routing_hidden_size", absl::GetFlag(FLAGS_routing_hidden_size), Same,
        &config_.routing_hidden_size);
    Set("ffn_size", absl::GetFlag(FLAGS_ffn_size), Same, &config_.ffn_size);
    SetEnum("coder", absl::GetFlag(FLAGS_coder), &config_.coder);
    SetEnum("phase_clock", absl::GetFlag(FLAGS_phase_clock), &config_.phase_clock);
    SetEnum("merge", absl::GetFlag(FLAGS_merge), &config_.merge);
    SetEnum("gate", absl::GetFlag(FLAGS_gate), &config_.gate);
    return status_.ok() ? config_.Validate() : status_;
  }

 private:
  static absl::StatusOr<int> Same(int value) { return value; }

  template <typename Enum>
  void SetEnum(absl::string_view flag, const absl::optional<std::string>& given, Enum* field) {
    const auto parse = [&](absl::string_view name) { return ParseEnum<Enum>(flag, name); };
    Set(flag, given, parse, field);
  }

  template <typename Given, typename Parse, typename Field>
  void Set(absl::string_view flag, const absl::optional<Given>& given, Parse parse, Field* field) {
    if (!given.has_value() || !status_.ok()) return;
    const absl::StatusOr<Field> value = parse(*given);
    if (!value.ok()) {
      status_ = value.status();
    } else if (fixed_ && *value != *field) {
      status_ = absl::InvalidArgumentError(
          absl::StrCat(flag, ": expected what --init has, or no such flag, received ", *given));
    } else {
      *field = *value;
    }
  }

  ModelConfig& config_;
  const bool fixed_;
  absl::Status status_;
};

absl::StatusOr<Policy> RandomPolicyFromFlags(const Dataset& dataset) {
  ModelConfig config;
  if (auto status = SetShapeFromFlags(&config); !status.ok()) return status;
  Policy policy = InitialPolicy(config, dataset, absl::GetFlag(FLAGS_seed).value_or(0));
  if (const auto offset = absl::GetFlag(FLAGS_return_offset); offset.has_value()) {
    policy.return_offset = static_cast<float>(*offset);
  }
  if (const auto scale = absl::GetFlag(FLAGS_return_scale); scale.has_value()) {
    if (!(*scale > 0.0) || !std::isfinite(*scale)) {
      return absl::InvalidArgumentError(
          absl::StrCat("return_scale: expected a number above 0, received ", *scale));
    }
    policy.return_scale = static_cast<float>(*scale);
  }
  return policy;
}

absl::StatusOr<Policy> GivenPolicyFromFlags(const std::string& path, const Dataset& dataset) {
  absl::StatusOr<Policy> policy = ReadPolicyFile(path);
  if (!policy.ok()) return policy.status();
  if (auto status = ShapeFlags(&policy->config, /*fixed=*/true).Apply(); !status.ok()) {
    return status;
  }
  if (policy->environment != dataset.environment) {
    return absl::InvalidArgumentError(absl::StrCat("init: expected a policy for ",
                                                   dataset.environment, ", received one for '",
                                                   policy->environment, "'"));
  }
  return policy;
}

}  // namespace

absl::StatusOr<TrainOptions> TrainOptionsFromFlags() {
  const absl::StatusOr<SurrogateKind> surrogate =
      ParseEnum<SurrogateKind>("surrogate", absl::GetFlag(FLAGS_surrogate));
  if (!surrogate.ok()) return surrogate.status();
  const TrainOptions options = {
      .seed = absl::GetFlag(FLAGS_seed).value_or(0),
      .iterations = absl::GetFlag(FLAGS_iterations),
      .batch = absl::GetFlag(FLAGS_batch),
      .clip_steps = absl::GetFlag(FLAGS_clip_steps),
      .learning_rate = absl::GetFlag(FLAGS_learning_rate),
      .weight_decay = absl::GetFlag(FLAGS_weight_decay),
      .warmup = absl::GetFlag(FLAGS_warmup),
      .clip_norm = absl::GetFlag(FLAGS_clip_norm),
      .action_noise = absl::GetFlag(FLAGS_action_noise),
      .validation = absl::GetFlag(FLAGS_validation),
      .rate_targets = {.hidden = absl::GetFlag(FLAGS_target_rate) / 100.0,
                       .readout = absl::GetFlag(FLAGS_readout_rate) / 100.0},
      .spike_penalty = absl::GetFlag(FLAGS_spike_penalty),
      .surrogate = {.kind = *surrogate, .slope = static_cast<float>(absl::GetFlag(FLAGS_slope))}};
  if (auto status = options.Validate(); !status.ok()) return status;
  return options;
}

absl::StatusOr<Dataset> DatasetFromFlags() {
  const std::vector<std::string> paths = absl::GetFlag(FLAGS_data);
  if (paths.empty()) {
    const absl::StatusOr<RecordOptions> options = RecordOptionsFromFlags();
    if (!options.ok()) return options.status();
    return RecordDataset(*options);
  }
  std::vector<Dataset> parts;
  for (const std::string& path : paths) {
    absl::StatusOr<Dataset> part =
        IsMinariDataset(path) ? ReadMinariDataset(path) : ReadDataset(path);
    if (!part.ok()) return part;
    parts.push_back(*std::move(part));
  }
  absl::StatusOr<Dataset> dataset = Concatenate(std::move(parts));
  if (!dataset.ok()) return dataset;
  const std::string environment = absl::GetFlag(FLAGS_env).value_or(dataset->environment);
  if (environment != dataset->environment) {
    return absl::InvalidArgumentError(absl::StrCat("env: expected ", dataset->environment,
                                                   " as in --data, received ", environment));
  }
  return dataset;
}

absl::Status SetShapeFromFlags(ModelConfig* config) {
  return ShapeFlags(config, /*fixed=*/false).Apply();
}

absl::StatusOr<Policy> InitialPolicyFromFlags(const Dataset& dataset) {
  const std::string path = absl::GetFlag(FLAGS_init);
  return path.empty() ? RandomPolicyFromFlags(dataset) : GivenPolicyFromFlags(path, dataset);
}

}  // namespace spikeserve
