#include "train/train_summary.h"

#include <algorithm>
#include <memory>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/types/span.h"
#include "core/base/status_macros.h"
#include "core/engine/factory/engine_factory.h"
#include "train/recording/policy_player.h"

namespace spikeserve {
namespace {

constexpr int kSteps = 1000;

std::string Why(TargetSource source, const Policy& policy) {
  switch (source) {
    case TargetSource::kFlag:
      return "from --target_return";
    case TargetSource::kInitialPolicy:
      return "that of --init; --target_return sets another";
    case TargetSource::kEnvironment:
      return absl::StrCat("the default for ", policy.environment, "; --target_return sets another");
    case TargetSource::kData:
      break;
  }
  return "the best return in the data; --target_return sets another";
}

std::string ShapeText(const Policy& policy) {
  const ModelConfig& config = policy.config;
  const ActionSpace& space = policy.action_space;
  const std::string shape = absl::StrFormat(
      "%d observations, %d %s; mode %s, hidden size %d, %d heads, %d layers, context %d, %d ticks",
      policy.observation_size(), space.size(), space.is_discrete() ? "actions" : "action elements",
      ToString(config.mode), config.hidden_size, config.heads, config.layers, config.context,
      config.ticks);
  return absl::StrCat(
      shape, config.observation_changes ? ", observation changes" : "",
      config.has_norms() ? "" : ", no norms",
      config.arithmetic == Arithmetic::kFloat32
          ? ""
          : absl::StrCat(", arithmetic ", std::string(ToString(config.arithmetic))));
}

// Returns how to play a policy in closed loop whose environment is not one of this program.
std::string HowToPlay(const Policy& policy) {
  const std::string environment =
      policy.environment.empty() ? "the environment" : policy.environment;
  return absl::StrCat(
      "closed-loop play: skipped, because spiketrain does not have ", environment,
      ". Serve the policy (docs/guides/policies.md) and play it with your own environment and "
      "spikeserve.evaluate of the Python client (docs/start/python.md)\n");
}

}  // namespace

absl::StatusOr<double> SpikesOnData(const Policy& policy, const EpisodeSource& source) {
  std::vector<int> first;
  for (int i = 0, steps = 0; steps < kSteps && i < static_cast<int>(source.entries().size()); ++i) {
    steps += source.entries()[i].steps;
    first.push_back(i);
  }
  ASSIGN_OR_RETURN(const std::vector<Episode> episodes, source.Read(first));
  const auto engine = MakeEngine(std::make_shared<const Policy>(policy));
  const auto size = static_cast<size_t>(policy.observation_size());
  double spikes = 0.0;
  int steps = 0;
  for (const Episode& episode : episodes) {
    PolicyPlayer player(*engine, static_cast<double>(policy.target_return));
    for (int step = 0; step < episode.steps() && steps < kSteps; ++step, ++steps) {
      const size_t begin = static_cast<size_t>(step) * size;
      const double reward = step == 0 ? 0.0 : episode.rewards[static_cast<size_t>(step) - 1];
      player.Act(absl::MakeConstSpan(episode.observations).subspan(begin, size), reward);
      spikes += static_cast<double>(player.counts().total_spikes());
    }
  }
  return spikes / std::max(steps, 1);
}

std::string ToText(const TrainSummary& summary, const Policy& policy) {
  std::string text = absl::StrCat("policy: ", summary.path, "\nshape: ", ShapeText(policy),
                                  "\ntarget return: ", policy.target_return, ", ",
                                  Why(summary.target_source, policy), "\n");
  if (summary.validation_loss >= 0.0) {
    absl::StrAppendFormat(&text, "validation loss: %.4f\n", summary.validation_loss);
  }
  if (summary.loss.has_value()) absl::StrAppend(&text, ToText(*summary.loss), "\n");
  if (summary.comparison.has_value()) text += ToText(*summary.comparison);
  if (summary.evaluation.has_value()) {
    return absl::StrCat(text, "closed-loop play: ", ToText(*summary.evaluation, policy.config),
                        ToText(summary.verdict));
  }
  absl::StrAppendFormat(&text, "spikes per decision: %.1f, on the observations of the data\n",
                        summary.spikes_on_data);
  return absl::StrCat(text, HowToPlay(policy), ToText(summary.verdict));
}

nlohmann::ordered_json ToJson(const TrainSummary& summary, const Policy& policy) {
  nlohmann::ordered_json json = summary.evaluation.has_value()
                                    ? ToJson(*summary.evaluation, policy.config)
                                    : nlohmann::ordered_json::object();
  json["policy_file"] = summary.path;
  json["shape"] = ShapeText(policy);
  json["target_return"] = policy.target_return;
  json["target_return_source"] = std::string(ToString(summary.target_source));
  if (summary.validation_loss >= 0.0) json["validation_loss"] = summary.validation_loss;
  if (summary.loss.has_value()) json["rounding_loss"] = ToJson(*summary.loss);
  if (summary.comparison.has_value()) {
    json["baselines"] = ToJson(*summary.comparison, /*with_weights=*/false);
  }
  json["verdict"] = ToJson(summary.verdict);
  json["closed_loop_play"] = summary.evaluation.has_value() ? "played" : "skipped";
  if (!summary.evaluation.has_value()) json["spikes_per_decision"] = summary.spikes_on_data;
  return json;
}

}  // namespace spikeserve
