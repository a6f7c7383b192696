#include "train/baselines/comparison.h"

#include <algorithm>
#include <cmath>
#include <optional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/base/rounded.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/environment/environment.h"
#include "train/data/clip_sampler.h"

namespace spikeserve {
namespace {

// Of all inputs: 4 MB, beside what --data_memory bounds. More change little: on Pendulum a
// perceptron returned -148.4 from 21,800 steps and -148.8 from 234,000.
constexpr int kMostTrainingNumbers = 1'000'000;
constexpr int kHeldOutSteps = 10'000;
// What a second observation has to gain: shares of the error of the first, and an error. Those of a
// perceptron are larger, because its error depends on chance, too.
constexpr double kLineGain = 0.05;
constexpr double kMlpGain = 0.25, kLeastMlpGain = 0.01;
constexpr int kFrames[] = {1, 2, 4};
// Of perceptrons. The better width is fitted from further seeds.
constexpr int kWidths[] = {32, 64};
constexpr uint64_t kFurtherSeeds = 2;

BaselineScore Score(Baseline baseline, const ActionSpace& space, const StepTable& table) {
  ImitationError error = ErrorOf(space, baseline.Outputs(table.inputs), table);
  return {.baseline = std::move(baseline), .error = std::move(error)};
}

// Returns the perceptron with the smallest error on held-out steps.
BaselineScore BestMlp(const ActionSpace& space, const BaselineData& data, int frames,
                      uint64_t seed) {
  std::optional<BaselineScore> best;
  const auto try_one = [&](const MlpFit& fit) {
    BaselineScore score =
        Score(FitMlp(space, data.training, data.held_out, frames, fit), space, data.held_out);
    if (!best.has_value() || score.error.mean < best->error.mean) best = std::move(score);
  };
  for (const int width : kWidths) try_one({.width = width, .seed = seed});
  const int width = best->baseline.width();
  for (uint64_t i = 1; i <= kFurtherSeeds; ++i) try_one({.width = width, .seed = seed + i});
  return *std::move(best);
}

Action ActionOf(const Baseline& baseline, const ActionSpace& space, const Eigen::VectorXf& input) {
  const RowMajorMatrix<float> outputs = baseline.Outputs(RowMajorMatrix<float>(input.transpose()));
  if (!space.is_discrete()) {
    return {.continuous = space.FromUnit({outputs.data(), static_cast<size_t>(outputs.size())})};
  }
  Eigen::Index chosen = 0;
  outputs.row(0).maxCoeff(&chosen);
  return {.discrete = static_cast<int>(chosen), .continuous = {}};
}

double PlayEpisode(const Baseline& baseline, Environment& environment, uint64_t seed) {
  FrameInput frames(environment.observation_size());
  StepResult result;
  result.observation = environment.Reset(seed);
  double episode_return = 0.0;
  while (!result.done()) {
    const Eigen::VectorXf& input = frames.Push(result.observation);
    result = environment.Step(ActionOf(baseline, environment.action_space(), input));
    episode_return += result.reward;
  }
  return episode_return;
}

std::string ErrorKind(const BaselineComparison& comparison) {
  return comparison.is_discrete ? "share of other actions than in the data"
                                : "mean squared difference of actions, mapped to [-1, 1]";
}

std::string Row(absl::string_view name, const ImitationError& error,
                const std::vector<double>& returns) {
  std::string row = std::isnan(error.mean)
                        ? absl::StrFormat("  %-16s none", name)
                        : absl::StrFormat("  %-16s %.4f  explains %.1f %%", name, error.mean,
                                          Rounded(100.0 * error.explained, 1));
  if (!returns.empty()) absl::StrAppendFormat(&row, "  return %.2f", AsVector(returns).mean());
  return row + "\n";
}

}  // namespace

absl::StatusOr<BaselineData> ReadBaselineData(const EpisodeSource& source, double validation) {
  if (const int size = source.dataset().observation_size; size > kMostBaselineInputs) {
    return InvalidArgument(
        "observations", absl::StrCat("at most ", kMostBaselineInputs, " numbers to fit baselines"),
        size);
  }
  const Split split = SplitEpisodes(source.entries(), validation);
  BaselineData data;
  data.is_held_out = !split.validation.empty();
  const int numbers = kMostFrames * std::max(1, source.dataset().observation_size);
  ASSIGN_OR_RETURN(data.training,
                   ReadSteps(source, split.training, kMostTrainingNumbers / numbers));
  ASSIGN_OR_RETURN(
      StepTable held_out,
      ReadSteps(source, data.is_held_out ? split.validation : split.training, kHeldOutSteps));
  data.held_out = std::move(held_out);
  return data;
}

bool NeedsChanges(const ActionSpace& space, const StepTable& table) {
  if (table.begins.size() < 3) return false;  // one episode
  const StepTable halves[] = {EverySecondEpisode(table, 0), EverySecondEpisode(table, 1)};
  // Returns whether a second observation helps the models that `fit` fits.
  const auto is_clear = [&](const auto& fit, double share, double least) {
    // Returns the errors of all episodes, each from a fit to the other half.
    const auto error_of = [&](int frames) {
      ImitationError error;
      for (const int i : {0, 1}) {
        const std::vector<double> episodes =
            Score(fit(halves[1 - i], halves[i], frames), space, halves[i]).error.episodes;
        error.episodes.insert(error.episodes.end(), episodes.begin(), episodes.end());
      }
      if (!error.episodes.empty()) error.mean = AsVector(error.episodes).mean();
      return error;
    };
    const ImitationError one = error_of(1), two = error_of(2);
    const MeanDifference gain = Compare(one, two);
    return gain.mean >= std::max(share * one.mean, least) && gain.is_significant();
  };
  const auto line = [&](const StepTable& half, const StepTable&, int frames) {
    return FitLine(space, half, frames);
  };
  const auto mlp = [&](const StepTable& half, const StepTable& other, int frames) {
    return FitMlp(space, half, other, frames, {.quick = true});
  };
  // Of an action that is no linear function of a velocity, a line may show nothing.
  return is_clear(line, kLineGain, 0.0) || is_clear(mlp, kMlpGain, kLeastMlpGain);
}

BaselineComparison CompareWithBaselines(std::shared_ptr<const Policy> policy,
                                        const BaselineData& data, uint64_t seed) {
  const ActionSpace space = policy->action_space;
  BaselineComparison comparison = {.is_discrete = space.is_discrete(),
                                   .is_held_out = data.is_held_out,
                                   .steps = data.held_out.rows(),
                                   .policy = ErrorOf(std::move(policy), data.held_out),
                                   .baselines = {}};
  for (const int frames : kFrames) {
    comparison.baselines.push_back(
        Score(FitLine(space, data.training, frames), space, data.held_out));
  }
  for (const int frames : kFrames) {
    comparison.baselines.push_back(BestMlp(space, data, frames, seed));
  }
  return comparison;
}

absl::Status PlayBaselines(absl::string_view environment, uint64_t first_seed,
                           std::vector<double> policy_returns, BaselineComparison* comparison) {
  ASSIGN_OR_RETURN(std::unique_ptr<Environment> made, MakeEnvironment(environment));
  for (BaselineScore& score : comparison->baselines) {
    for (size_t i = 0; i < policy_returns.size(); ++i) {
      score.returns.push_back(PlayEpisode(score.baseline, *made, first_seed + i));
    }
  }
  comparison->policy_returns = std::move(policy_returns);
  return absl::OkStatus();
}

std::vector<std::string> Warnings(const BaselineComparison& comparison) {
  std::vector<std::string> warnings;
  for (const BaselineScore& score : comparison.baselines) {
    const MeanDifference error = Compare(comparison.policy, score.error);
    if (error.is_significant()) {
      warnings.push_back(absl::StrFormat(
          "%s imitates better than the policy: error %.4f against %.4f (by %.4f ± %.4f)",
          score.baseline.Name(), score.error.mean, comparison.policy.mean, error.mean,
          error.standard_error));
    }
    const MeanDifference gain = Compare(score.returns, comparison.policy_returns);
    if (!gain.is_significant()) continue;
    warnings.push_back(absl::StrFormat("%s returns more than the policy: %.2f (by %.2f ± %.2f)",
                                       score.baseline.Name(), AsVector(score.returns).mean(),
                                       gain.mean, gain.standard_error));
  }
  return warnings;
}

std::string ToText(const BaselineComparison& comparison) {
  std::string text =
      absl::StrFormat("error on %d %s steps (%s):\n", comparison.steps,
                      comparison.is_held_out ? "held-out" : "training", ErrorKind(comparison));
  text += Row("the policy", comparison.policy, comparison.policy_returns);
  for (const BaselineScore& score : comparison.baselines) {
    text += Row(score.baseline.Name(), score.error, score.returns);
  }
  for (const std::string& warning : Warnings(comparison)) {
    absl::StrAppend(&text, "warning: ", warning, "\n");
  }
  return text;
}

nlohmann::ordered_json ToJson(const BaselineComparison& comparison, bool with_weights) {
  const auto score = [](const ImitationError& error, const std::vector<double>& returns) {
    nlohmann::ordered_json json = {{"error", error.mean}, {"explained", error.explained}};
    if (!error.elements.empty()) {
      json["error_by_element"] = error.elements;
      json["explained_by_element"] = error.explained_elements;
    }
    if (!returns.empty()) json["mean_return"] = AsVector(returns).mean();
    return json;
  };
  nlohmann::ordered_json json = {{"error_is", ErrorKind(comparison)},
                                 {"steps", comparison.steps},
                                 {"held_out", comparison.is_held_out},
                                 {"policy", score(comparison.policy, comparison.policy_returns)},
                                 {"warnings", Warnings(comparison)}};
  for (const BaselineScore& baseline : comparison.baselines) {
    nlohmann::ordered_json entry = {{"name", baseline.baseline.Name()}};
    if (const int width = baseline.baseline.width(); width > 0) entry["width"] = width;
    entry.update(score(baseline.error, baseline.returns));
    if (with_weights) entry.update(baseline.baseline.ToJson());
    json["baselines"].push_back(std::move(entry));
  }
  return json;
}

}  // namespace spikeserve
