#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <memory>
#include <numeric>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "core/action/step_source.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/dataset/recordings.h"
#include "train/commands.h"
#include "train/decided_episodes.h"
#include "train/evaluation/off_policy_episodes.h"
#include "train/evaluation/training_record.h"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

struct OpeFlags {
  std::string recordings;
  std::string policy;
  OffPolicyConditions conditions;
  bool json = false;
};

// Upper ends of the drawn weights; the last ones have none.
constexpr std::array<double, 5> kWeights = {0.01, 0.1, 1.0, 10.0, 100.0};
constexpr size_t kBar = 40;  // characters of a bar for all episodes
constexpr int kShownSteps = 5;

// Returns how many episodes have a weight up to each end, and above the last one.
std::array<size_t, kWeights.size() + 1> CountWeights(const OffPolicyEvaluation& evaluation) {
  std::array<size_t, kWeights.size() + 1> counts = {};
  for (const double weight : evaluation.weights) {
    const auto end = std::lower_bound(kWeights.begin(), kWeights.end(), weight);
    ++counts[static_cast<size_t>(end - kWeights.begin())];
  }
  return counts;
}

std::string ToText(const OffPolicyInterval& interval) {
  return absl::StrFormat("%.4g (%.4g to %.4g)", interval.value, interval.low, interval.high);
}

std::string OverlapText(const OffPolicyEvaluation& evaluation) {
  std::string text = "effective episodes up to step";
  const std::vector<double>& effective = evaluation.effective_by_step;
  for (int i = 0; i <= kShownSteps; ++i) {
    const size_t step = (effective.size() - 1) * static_cast<size_t>(i) / kShownSteps;
    absl::StrAppendFormat(&text, "%s %d: %.1f", i == 0 ? "" : ",", step + 1, effective[step]);
  }
  text += "\nepisodes by weight (1: as probable as with the recorded policy, on average)\n";
  const auto counts = CountWeights(evaluation);
  for (size_t i = 0; i < counts.size(); ++i) {
    const bool last = i == kWeights.size();
    const size_t bar = (counts[i] * kBar + evaluation.episodes - 1) / evaluation.episodes;
    absl::StrAppendFormat(&text, "  %s %-6g %6d %s\n", last ? "above" : "up to",
                          kWeights[last ? i - 1 : i], counts[i], std::string(bar, '#'));
  }
  return text;
}

// Returns the numbers of steps that others than the policy have chosen, by who.
ordered_json OtherSteps(const RecordedDecisions& decisions) {
  ordered_json others = ordered_json::object();
  for (const auto& [kind, name] : EnumNames(SourceKind())) {
    const size_t steps = decisions.steps[static_cast<size_t>(kind)];
    if (kind != SourceKind::kPolicy && steps > 0) others[std::string(name)] = steps;
  }
  return others;
}

std::string OtherStepsText(const RecordedDecisions& decisions) {
  const ordered_json others = OtherSteps(decisions);
  std::vector<std::string> parts;
  for (const auto& [name, steps] : others.items()) {
    parts.push_back(absl::StrCat(name, " ", steps.get<size_t>()));
  }
  if (parts.empty()) return "";
  return absl::StrFormat(
      "of %d steps others have chosen: %s; the estimate is for a version that meets them, too\n",
      std::accumulate(decisions.steps.begin(), decisions.steps.end(), size_t{0}),
      absl::StrJoin(parts, ", "));
}

std::string ToText(const RecordedDecisions& decisions, const OffPolicyEvaluation& evaluation) {
  std::string text =
      absl::StrFormat("%s/%d played %d episodes: mean return %.4g\n", decisions.policy,
                      decisions.version, evaluation.episodes, evaluation.recorded_return);
  text += OtherStepsText(decisions);
  const std::pair<const char*, const OffPolicyEstimate*> estimates[] = {
      {"doubly robust", &evaluation.doubly_robust},
      {"importance sampling", &evaluation.importance_sampling}};
  for (const auto& [name, estimate] : estimates) {
    absl::StrAppendFormat(&text, "new policy, %-20s return %s, difference %s\n",
                          absl::StrCat(name, ":"), ToText(estimate->new_return),
                          ToText(estimate->difference));
  }
  absl::StrAppendFormat(&text,
                        "verdict: %s; %.1f effective episodes, %d independent ones or sessions; at "
                        "least %g and %d can tell\n",
                        evaluation.verdict(), evaluation.effective(), evaluation.units,
                        kFewestEffective, kFewestUnits);
  return text + OverlapText(evaluation);
}

ordered_json ToJson(const OffPolicyEstimate& estimate) {
  const auto list = [](const OffPolicyInterval& interval) {
    return ordered_json{interval.value, interval.low, interval.high};
  };
  return {{"new_return", list(estimate.new_return)}, {"difference", list(estimate.difference)}};
}

// The first fields are those of OfflineEvaluation in policy_admin.proto.
ordered_json ToJson(const RecordedDecisions& decisions, const std::string& sha256,
                    const OffPolicyEvaluation& evaluation) {
  const auto& [fresh, difference] = evaluation.doubly_robust;
  return {{"recorded_sha256", decisions.sha256},
          {"new_sha256", sha256},
          {"episodes", evaluation.episodes},
          {"effective_episodes", evaluation.effective()},
          {"can_tell", evaluation.can_tell()},
          {"recorded_return", evaluation.recorded_return},
          {"new_return", fresh.value},
          {"new_return_low", fresh.low},
          {"new_return_high", fresh.high},
          {"difference", difference.value},
          {"difference_low", difference.low},
          {"difference_high", difference.high},
          {"verdict", evaluation.verdict()},
          {"policy", decisions.policy},
          {"recorded_version", decisions.version},
          {"units", evaluation.units},
          {"other_steps", OtherSteps(decisions)},
          {"importance_sampling", ToJson(evaluation.importance_sampling)},
          {"weight_ends", kWeights},
          {"episodes_by_weight", CountWeights(evaluation)},
          {"effective_by_step", evaluation.effective_by_step}};
}

absl::Status CheckConditions(const OffPolicyConditions& conditions) {
  const double temperature = conditions.temperature.value_or(1.0);
  if (!std::isfinite(temperature) || temperature <= 0.0) {
    return InvalidArgument("--temperature", "a number above 0", temperature);
  }
  if (const double target = conditions.target_return.value_or(0.0); !std::isfinite(target)) {
    return InvalidArgument("--target_return", "a finite number", target);
  }
  return absl::OkStatus();
}

absl::Status EvaluateOffline(const OpeFlags& flags) {
  RETURN_IF_ERROR(CheckConditions(flags.conditions));
  ASSIGN_OR_RETURN(const auto policy, ReadRequiredPolicy(flags.policy));
  ASSIGN_OR_RETURN(const std::string sha256, FileSha256(flags.policy));
  if (flags.recordings.empty()) {
    return InvalidArgument("--recordings", "a folder", "none");
  }
  const auto recordings = ReadRecordings(flags.recordings, policy->environment);
  if (!recordings.ok()) return Annotate(recordings.status(), "--recordings");
  const auto decisions = DecideRecorded(*recordings, policy, flags.conditions);
  if (!decisions.ok()) return Annotate(decisions.status(), "--recordings");
  const OffPolicyEvaluation evaluation = EvaluateOffPolicy(decisions->episodes);
  std::fputs((flags.json ? ToJson(*decisions, sha256, evaluation).dump(2) + "\n"
                         : ToText(*decisions, evaluation))
                 .c_str(),
             stdout);
  return absl::OkStatus();
}

}  // namespace

void AddOpeCommand(Program& program) {
  const Command command = program.root().AddCommand(
      "ope", "Estimates a policy's return from episodes of another version");
  const auto flags = std::make_shared<OpeFlags>();
  command.Flags("Off-policy evaluation")
      .Add("recordings", "PATH", &flags->recordings,
           "Episodes that a server recorded, with sampled actions")
      .Add("policy", "FILE", &flags->policy, "Policy file of the new version")
      .Add("temperature", "X", &flags->conditions.temperature,
           "Temperature of the new policy; default: as recorded")
      .Add("target_return", "RETURN", &flags->conditions.target_return,
           "Target return of the new policy; default: as recorded")
      .AddSwitch("json", &flags->json, "Print one JSON object instead of text");
  command.SetAction([flags] { return EvaluateOffline(*flags); });
}

}  // namespace spikeserve
