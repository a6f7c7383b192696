#include "train/train_flags.h"

#include <string>
#include <utility>

#include "absl/strings/match.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "core/base/status_macros.h"
#include "train/record_flags.h"
#include "train/trainer/device.h"

namespace spikeserve {
namespace {

// Calls `visit(name, flag, field)` for every flag of the shape except the size of the FFN, whose
// default depends on the hidden size.
template <typename Visit>
void ForEachFlag(const ShapeFlags& flags, ModelConfig& config, const Visit& visit) {
  visit("mode", flags.mode, config.mode);
  visit("hidden_size", flags.hidden_size, config.hidden_size);
  visit("heads", flags.heads, config.heads);
  visit("layers", flags.layers, config.layers);
  visit("ticks", flags.ticks, config.ticks);
  visit("context", flags.context, config.context);
  visit("routing_hidden_size", flags.routing_hidden_size, config.routing_hidden_size);
  visit("phase_clock", flags.phase_clock, config.phase_clock);
  visit("merge", flags.merge, config.merge);
  visit("gate", flags.gate, config.gate);
  visit("observation_changes", flags.observation_changes, config.observation_changes);
}

// Adds a flag whose default is the value of `paper`, or with --init that of the initial policy.
template <typename T>
void AddOptional(FlagGroup& group, const char* name, const std::string& kind,
                 std::optional<T>* value, T paper, const char* help) {
  group.Add(name, kind, value, absl::StrCat(help, "; default: ", FlagValueText(paper)));
}

absl::StatusOr<DelayRange> ParseDelay(const std::string& text) {
  constexpr int kMost = 1000;
  const std::pair<absl::string_view, absl::string_view> ends =
      absl::StrSplit(text, absl::MaxSplits("..", 1));
  const bool is_range = absl::StrContains(text, "..");
  DelayRange range;
  const bool parsed = absl::SimpleAtoi(ends.first, &range.least) &&
                      absl::SimpleAtoi(is_range ? ends.second : ends.first, &range.most);
  if (parsed && 0 <= range.least && range.least <= range.most && range.most <= kMost) return range;
  return absl::InvalidArgumentError(
      absl::StrCat("--delay: expected 0 to ", kMost,
                   " steps, as a number like 3 or a range like 0..5, received ", text));
}

}  // namespace

void AddModeFlag(FlagGroup& group, ShapeFlags* flags) {
  AddOptional(group, "mode", EnumKind<Mode>(), &flags->mode, ModelConfig().mode, "Attention");
}

void AddShapeFlags(FlagGroup& group, ShapeFlags* flags) {
  const ModelConfig paper;
  AddOptional(group, "hidden_size", "D", &flags->hidden_size, paper.hidden_size, "Hidden size d");
  AddOptional(group, "heads", "H", &flags->heads, paper.heads, "Attention heads");
  AddOptional(group, "layers", "L", &flags->layers, paper.layers, "Layers");
  AddOptional(group, "ticks", "T", &flags->ticks, paper.ticks, "Ticks of a token");
  AddOptional(group, "context", "N", &flags->context, paper.context, "Context in timesteps");
  AddOptional(group, "routing_hidden_size", "M", &flags->routing_hidden_size,
              paper.routing_hidden_size, "Hidden size of the routing");
  group.Add("ffn_size", "N", &flags->ffn_size, "Hidden size of the FFN; default: 4 d");
  AddOptional(group, "phase_clock", EnumKind<PhaseClock>(), &flags->phase_clock, paper.phase_clock,
              "Clock of the phase spikes");
  AddOptional(group, "merge", EnumKind<Merge>(), &flags->merge, paper.merge, "Merge of the heads");
  AddOptional(group, "gate", EnumKind<Gate>(), &flags->gate, paper.gate, "Gate of the routing");
}

void AddTrainerFlags(Command command, TrainerFlags* flags) {
  TrainOptions& options = flags->options;
  command.Flags("Optimiser")
      .Add("iterations", "N", &options.iterations, "Iterations")
      .Add("batch", "N", &options.batch, "Clips of an iteration")
      .Add("clip_steps", "N", &options.clip_steps, "Timesteps of a clip; 0: the policy's context")
      .Add("padding", EnumKind<Padding>(), &options.padding,
           "Where clips that exceed an episode have zeros")
      .Add("learning_rate", "RATE", &options.learning_rate, "Peak learning rate of AdamW")
      .Add("schedule", EnumKind<Schedule>(), &options.schedule, "Learning rate after the warm-up")
      .Add("weight_decay", "X", &options.weight_decay, "Weight decay of AdamW")
      .Add("warmup", "N", &options.warmup, "Iterations of linear warm-up")
      .Add("clip_norm", "X", &options.clip_norm, "Largest norm of the gradient")
      .Add("action_noise", "P", &options.action_noise, "Probability of a random action token")
      .Add("delay", "STEPS", &flags->delay,
           "Steps until a decision is executed: 3, or 0..5 drawn by clip")
      .Add("validation", "SHARE", &options.validation, "Share of episodes held out")
      .Add("threads", "N", &options.threads, "Threads; their number decides the last bits")
      .Add("device", "cpu|cuda|cuda:N", &flags->device, "Where to compute; CUDA is not tested")
      .AddList("freeze", "NAME,...", &options.frozen,
               "Tensors that are not trained, by name or part: head, routing.hidden");
  command.Flags("Plasticity")
      .Add("local_rate", "ETA", &options.plasticity.rate,
           "Rate of the head's three-factor rule; 0: not used")
      .Add("local_rule", EnumKind<Rule>(), &options.plasticity.rule, "Postsynaptic factor")
      .Add("trace_decay", "LAMBDA", &options.plasticity.trace_decay, "Decay of the traces");
  command.Flags("Spikes")
      .Add("target_rate", "PERCENT", &flags->target_rate,
           "Percent of ticks above which firing is penalised")
      .Add("readout_rate", "PERCENT", &flags->readout_rate, "The same for the readout coder")
      .Add("spike_penalty", "X", &options.spike_penalty, "Weight of the penalty")
      .Add("operation_penalty", "X", &options.operation_penalty,
           "Weight of a penalty on synaptic operations")
      .Add("surrogate", EnumKind<SurrogateKind>(), &options.surrogate.kind, "Surrogate gradient")
      .Add("slope", "K", &options.surrogate.slope, "Slope of the surrogate gradient");
}

absl::StatusOr<TrainOptions> MakeTrainOptions(const TrainerFlags& flags) {
  TrainOptions options = flags.options;
  ASSIGN_OR_RETURN(options.delay, ParseDelay(flags.delay));
  ASSIGN_OR_RETURN(options.device, DeviceNamed(flags.device));
  options.rate_targets = {.hidden = flags.target_rate / 100.0,
                          .readout = flags.readout_rate / 100.0};
  if (absl::Status status = options.Validate(); !status.ok()) return NameFlag(status);
  return options;
}

absl::Status SetShape(const ShapeFlags& flags, ModelConfig* config) {
  ForEachFlag(flags, *config, [](const char*, const auto& flag, auto& field) {
    if (flag.has_value()) field = *flag;
  });
  config->ffn_size = flags.ffn_size.value_or(4 * config->hidden_size);
  if (absl::Status status = config->Validate(); !status.ok()) return NameFlag(status);
  return absl::OkStatus();
}

absl::Status ContinueShape(const ShapeFlags& flags, ModelConfig* config) {
  config->ticks = flags.ticks.value_or(config->ticks);
  if (absl::Status valid = config->Validate(); !valid.ok()) return NameFlag(valid);
  absl::Status status;
  const auto check = [&](const char* name, const auto& flag, const auto& field) {
    if (!flag.has_value() || *flag == field) return;
    status.Update(absl::InvalidArgumentError(
        absl::StrCat("--", name, ": expected what --init has, ", FlagValueText(field),
                     ", or no such flag, received ", FlagValueText(*flag))));
  };
  ForEachFlag(flags, *config, check);
  check("ffn_size", flags.ffn_size, config->ffn_size);
  return status;
}

}  // namespace spikeserve
