#include <cstdio>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/environment/environment.h"
#include "core/model/policy_file.h"
#include "core/quantize/int8_file.h"
#include "core/quantize/prune_hidden.h"
#include "core/quantize/quantize_integer.h"
#include "train/baselines/verdict.h"
#include "train/commands.h"
#include "train/data/episode_source.h"
#include "train/evaluation/calibration.h"
#include "train/evaluation/paired_evaluation.h"
#include "train/evaluation/rounding_loss.h"
#include "train/evaluation/training_record.h"
#include "train/loss_gate.h"
#include "train/record_flags.h"
#include "train/recording/policy_player.h"

namespace spikeserve {
namespace {

constexpr char kAdvice[] =
    "calibrate with more --data, keep more parts by --mode, train through the integers "
    "(`spiketrain train --arithmetic=integer --init=POLICY`)";

struct QuantizeFlags {
  std::string policy;
  std::string out;
  Arithmetic to = Arithmetic::kInteger;
  IntegerOptions integer;         // of --to=integer
  std::vector<std::string> data;  // its calibration set; empty: episodes that the policy plays
  bool prune = false;
  EvaluationOptions options = {.episodes = 1000, .first_seed = 2'000'000};
  LossGate gate;
  std::string returns;  // of both policies, that another program played; empty: play them
  Grade require = Grade::kBad;
  bool json = false;
};

absl::Status CheckFlags(const QuantizeFlags& flags) {
  if (flags.policy.empty()) {
    return InvalidArgument("--policy", "a policy file", "none");
  }
  if (flags.out.empty()) {
    return InvalidArgument("--out", "the file to write", "none");
  }
  const bool is_for_integer = flags.integer.mode.has_value() || !flags.data.empty() ||
                              flags.prune || !flags.returns.empty();
  if (is_for_integer && flags.to != Arithmetic::kInteger) {
    return InvalidArgument("--mode, --data, --prune, --returns", "with --to=integer",
                           "--to=float32");
  }
  RETURN_IF_ERROR(flags.gate.Validate());
  const absl::Status status = flags.options.Validate();
  return status.ok() ? status : NameFlag(status);
}

// Returns the calibration set. Without recorded data, these are episodes that the policy plays,
// where its environment is ours.
absl::StatusOr<std::vector<Episode>> CalibrationSet(const Policy& policy,
                                                    const std::vector<std::string>& data) {
  if (data.empty()) {
    absl::StatusOr<std::vector<Episode>> played = PlayCalibrationEpisodes(policy);
    if (!absl::IsNotFound(played.status())) return played;
    return InvalidArgument("--data", absl::StrCat("recorded episodes of ", policy.environment),
                           "none");
  }
  constexpr int64_t kMemory = int64_t{4} << 30;
  ASSIGN_OR_RETURN(const EpisodeSource source, EpisodeSource::Open(data, kMemory));
  RETURN_IF_ERROR(CheckSpacesMatch(policy, source.dataset()));
  if (!source.resident()) {
    return InvalidArgument("--data", "at most 4 GiB of episodes", "more");
  }
  // The policy is asked for its own target, not for the returns that the recorded actor reached.
  std::vector<Episode> episodes = source.dataset().episodes;
  for (Episode& episode : episodes) {
    if (!episode.target_return.has_value()) episode.target_return = policy.target_return;
  }
  return episodes;
}

absl::StatusOr<Policy> RoundToInteger(const Policy& policy, const QuantizeFlags& flags) {
  if (flags.prune && policy.config.is_dense()) {
    return InvalidArgument("--prune", "a mode with spikes", "dense");
  }
  ASSIGN_OR_RETURN(const std::vector<Episode> episodes, CalibrationSet(policy, flags.data));
  const absl::StatusOr<float> largest = LargestInput(policy, episodes);
  if (!largest.ok()) return Annotate(largest.status(), "--data");
  IntegerOptions options = flags.integer;
  options.largest_input = 2.0f * *largest;  // leaves room for inputs that the set lacks
  if (!policy.config.has_norms()) options.largest_residual = LargestResidual(policy, episodes);
  absl::StatusOr<Policy> integer = QuantizeToInteger(policy, options);
  if (!integer.ok() || !flags.prune) return integer;
  return PruneHidden(*integer, FiringHiddenNeurons(*integer, episodes));
}

// Converts the policy to the arithmetic of --to.
absl::StatusOr<Policy> Round(const ConvertiblePolicy& parent, const QuantizeFlags& flags) {
  if (flags.to == Arithmetic::kFloat32) {
    if (parent.was_int8) return parent.policy;
    return InvalidArgument(
        "--to=float32", "a policy in int8",
        absl::StrCat("one in ", std::string(ToString(parent.policy.config.arithmetic))));
  }
  absl::StatusOr<Policy> rounded = RoundToInteger(parent.policy, flags);
  if (!rounded.ok()) return Annotate(rounded.status(), flags.policy);
  return rounded;
}

// Plays both policies where their environment is ours and they differ; nothing otherwise.
absl::StatusOr<std::optional<PairedEvaluation>> PlayBoth(const Policy& parent,
                                                         const Policy& integer,
                                                         const QuantizeFlags& flags) {
  if (!integer.config.is_integer() || !flags.returns.empty() ||
      !MakeEnvironment(parent.environment).ok()) {
    return std::optional<PairedEvaluation>();
  }
  ASSIGN_OR_RETURN(PairedEvaluation pair,
                   EvaluatePair(std::make_shared<const Policy>(parent),
                                std::make_shared<const Policy>(integer), flags.options));
  return std::optional<PairedEvaluation>(std::move(pair));
}

// Measures what rounding cost, by returns or, where nobody played, by the actions of the recorded
// data, unless any loss is allowed.
absl::StatusOr<std::optional<RoundingLoss>> MeasureLoss(
    const Policy& parent, const Policy& integer, const QuantizeFlags& flags,
    const std::optional<PairedEvaluation>& pair) {
  if (!flags.returns.empty()) {
    ASSIGN_OR_RETURN(const std::string json, ReadFile(flags.returns));
    const absl::StatusOr<RoundingLoss> loss = ParseLostReturn(json);
    if (!loss.ok()) return Annotate(loss.status(), "--returns");
    return std::optional<RoundingLoss>(*loss);
  }
  if (pair.has_value()) {
    ASSIGN_OR_RETURN(const RoundingLoss loss, LostReturn(parent, *pair));
    return std::optional<RoundingLoss>(loss);
  }
  if (flags.data.empty() || flags.gate.max_loss == 1.0) return std::optional<RoundingLoss>();
  ASSIGN_OR_RETURN(const std::vector<Episode> episodes, CalibrationSet(parent, flags.data));
  return std::optional<RoundingLoss>(LostAgreement(parent, integer, episodes));
}

// The record of how the integer policy came to be.
std::string QuantizationRecord(const std::string& command_line,
                               const nlohmann::ordered_json& sources,
                               const std::optional<PairedEvaluation>& pair,
                               const std::optional<RoundingLoss>& loss, const Policy& parent,
                               const ModelConfig& config) {
  nlohmann::ordered_json record = {{"command", command_line}};
  record.update(sources);
  if (loss.has_value()) record["rounding_loss"] = ToJson(*loss);
  if (pair.has_value()) {
    record["paired_returns"] = ToJson(*pair);
    record["evaluation"] = ToJson(pair->second, config);
  }
  AddLineage(parent.training, &record);
  return record.dump();
}

// Judges by what was lost: a policy that was refused is not judged. One episode shows nothing.
PolicyVerdict VerdictOf(const QuantizeFlags& flags, const std::optional<RoundingLoss>& loss) {
  PolicyVerdict verdict;
  if (flags.to == Arithmetic::kFloat32) {
    verdict.grade = Grade::kGood;
    verdict.reason = "nothing was rounded";
    return verdict;
  }
  if (!loss.has_value()) {
    verdict.reason =
        "what the integers lost was not measured, because --max_loss=1 allows any loss";
    verdict.advice.push_back("a --max_loss below 1, which measures the agreement with --data");
    return verdict;
  }
  verdict.figures = {{"rounding_loss", ToJson(*loss)}};
  verdict.reason = ToText(*loss);
  if (!loss->loss.is_bounded()) {
    verdict.advice.push_back("more episodes, because chance may explain any loss in one");
    return verdict;
  }
  const bool kept = !IsTooMuch(*loss, flags.gate.max_loss);
  verdict.grade = kept ? Grade::kGood : Grade::kBad;
  if (!kept) {
    verdict.advice.push_back("`spiketrain train --arithmetic=integer --init=POLICY`");
  }
  return verdict;
}

absl::Status QuantizePolicy(const QuantizeFlags& flags, const std::string& command_line) {
  RETURN_IF_ERROR(CheckFlags(flags));
  ASSIGN_OR_RETURN(const ConvertiblePolicy source, ReadConvertiblePolicy(flags.policy));
  const Policy& parent = source.policy;
  ASSIGN_OR_RETURN(const nlohmann::ordered_json sources, IdentifySources(flags.policy, flags.data));
  ASSIGN_OR_RETURN(Policy integer, Round(source, flags));
  ASSIGN_OR_RETURN(const std::optional<PairedEvaluation> pair, PlayBoth(parent, integer, flags));
  ASSIGN_OR_RETURN(const std::optional<RoundingLoss> loss,
                   MeasureLoss(parent, integer, flags, pair));
  if (loss.has_value()) RETURN_IF_ERROR(flags.gate.Check(*loss, kAdvice));
  RETURN_IF_ERROR(MakeDirectoryOf(flags.out));
  integer.training = QuantizationRecord(command_line, sources, pair, loss, parent, integer.config);
  RETURN_IF_ERROR(WritePolicyFile(integer, flags.out));
  const PolicyVerdict verdict = VerdictOf(flags, loss);
  nlohmann::ordered_json json = pair.has_value() ? ToJson(*pair) : nlohmann::ordered_json::object();
  json["verdict"] = ToJson(verdict);
  const std::string text = pair.has_value() ? ToText(*pair, "before", "after") : "";
  std::fputs((flags.json ? json.dump(2) + "\n" : text + ToText(verdict)).c_str(), stdout);
  return CheckGrade(verdict, flags.require);
}

}  // namespace

void AddQuantizeCommand(Program& program) {
  const Command command =
      program.root().AddCommand("quantize", "Rounds a policy to integers, or converts one in int8");
  const auto flags = std::make_shared<QuantizeFlags>();
  FlagGroup rounding = command.Flags("Rounding");
  rounding.Add("policy", "FILE", &flags->policy, "Policy file in float32, or in int8")
      .Add("out", "FILE", &flags->out, "Policy file to write")
      .Add("to", EnumKind<Arithmetic>(), &flags->to,
           "Numbers of the new policy; float32 for one in int8")
      .Add("episodes", "N", &flags->options.episodes, "Episodes that both policies play")
      .Add("seed", "N", &flags->options.first_seed,
           "Seed of the first start; later episodes count on");
  flags->gate.AddTo(rounding);
  rounding
      .Add("returns", "FILE", &flags->returns,
           "Returns of both policies from another program; default: play them")
      .Add("require", EnumKind<Grade>(), &flags->require,
           "Fail with a lower verdict; the policy is written all the same")
      .AddSwitch("json", &flags->json, "Print one JSON object instead of text");
  command.Flags("Integer arithmetic (--to=integer)")
      .Add("mode", EnumKind<Mode>(), &flags->integer.mode,
           "Leaves out the parts that this mode lacks; default: none")
      .AddSwitch("prune", &flags->prune,
                 "Leave out hidden neurons that never fire in the calibration set")
      .AddList("data", "FILE,...", &flags->data,
               "Calibration set; default: 200 episodes that the policy plays");
  command.SetAction([flags, &program] { return QuantizePolicy(*flags, program.CommandLine()); });
}

}  // namespace spikeserve
