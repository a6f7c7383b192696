#include "train/evaluation/rounding_loss.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <numeric>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/action/action_head.h"
#include "core/base/rounded.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/engine/factory/engine_factory.h"
#include "core/environment/environment.h"
#include "core/math/counter_random.h"
#include "train/data/dataset.h"
#include "train/recording/actors.h"

namespace spikeserve {
namespace {

constexpr int kRandomEpisodes = 100;

// Returns the mean return of uniformly random actions on the first starts of `options`.
double RandomReturn(Environment& environment, const EvaluationOptions& options) {
  const int episodes = std::min(options.episodes, kRandomEpisodes);
  double sum = 0.0;
  for (int i = 0; i < episodes; ++i) {
    const uint64_t seed = options.first_seed + static_cast<uint64_t>(i);
    const Actor actor = RandomActor(environment.action_space(),
                                    [seed, step = uint64_t{0}](uint64_t, uint64_t draw) mutable {
                                      return RandomBits({seed, step++, draw});
                                    });
    StepResult result;
    result.observation = environment.Reset(seed);
    while (!result.done()) {
      result = environment.Step(actor({environment.state(), result.observation, 0.0}).action);
      sum += result.reward;
    }
  }
  return sum / episodes;
}

// Returns how far a decided action agrees with the recorded one, from 0 to 1.
double Agreement(const ActionSpace& space, const Action& decided, const Action& recorded) {
  if (space.is_discrete()) return decided.discrete == recorded.discrete ? 1.0 : 0.0;
  double distance = 0.0;
  for (size_t i = 0; i < decided.continuous.size(); ++i) {
    const double width = static_cast<double>(space.high[i]) - static_cast<double>(space.low[i]);
    distance += std::abs(decided.continuous[i] - recorded.continuous[i]) / width;
  }
  return 1.0 - distance / static_cast<double>(decided.continuous.size());
}

// Returns the mean agreement of each episode.
std::vector<double> Agreements(const Policy& policy, absl::Span<const Episode> episodes) {
  const auto engine = MakeEngine(policy);
  const auto size = static_cast<size_t>(policy.observation_size());
  std::vector<float> encoded(static_cast<size_t>(policy.action_space.size()));
  std::vector<double> agreements;
  Engine::Output output;
  for (const Episode& episode : episodes) {
    const auto context = engine->NewContext();
    const std::vector<float> returns = ReturnsToGo(episode);
    double sum = 0.0;
    for (size_t t = 0; t < episode.actions.size(); ++t) {
      engine->Decide(*context, returns[t],
                     absl::MakeConstSpan(episode.observations).subspan(t * size, size), &output);
      const ActionChoice choice =
          ChooseAction(policy.weights.head, policy.action_space, output.readout, {}, 0);
      sum += Agreement(policy.action_space, choice.action, episode.actions[t]);
      policy.action_space.Encode(episode.actions[t], absl::MakeSpan(encoded));
      engine->AppendAction(*context, encoded);
    }
    if (!episode.actions.empty()) {
      agreements.push_back(sum / static_cast<double>(episode.actions.size()));
    }
  }
  return agreements;
}

// Returns the loss whose range ends at the return of random actions.
RoundingLoss LossOf(double before, double random, std::vector<double> gains) {
  // A policy that is no better than chance has nothing to lose.
  const double range = std::max(before - random, 0.0);
  for (double& gain : gains) gain = range > 0.0 ? -gain / range : 0.0;
  return {.measure = "return", .range = range, .loss = MeanWithInterval(gains)};
}

}  // namespace

absl::StatusOr<RoundingLoss> LostReturn(const Policy& parent, const PairedEvaluation& pair) {
  ASSIGN_OR_RETURN(const std::unique_ptr<Environment> environment,
                   MakeEnvironment(parent.environment));
  return LossOf(pair.first.mean_return(), RandomReturn(*environment, pair.first.options),
                pair.differences());
}

absl::StatusOr<RoundingLoss> ParseLostReturn(absl::string_view json) {
  const auto object = nlohmann::json::parse(json, nullptr, /*allow_exceptions=*/false);
  const auto numbers = [&](const char* key) {
    std::vector<double> values;
    if (!object.is_object() || !object.contains(key)) return values;
    for (const auto& value : object[key]) {
      values.push_back(value.is_number() ? value.get<double>() : std::nan(""));
    }
    return values;
  };
  const std::vector<double> before = numbers("before");
  const std::vector<double> random = numbers("random");
  std::vector<double> gains = numbers("after");
  if (before.empty() || before.size() != gains.size() || random.size() != 1) {
    return InvalidArgument("returns", "before and after, of as many episodes, and random",
                           absl::StrCat(before.size(), ", ", gains.size(), " and ", random.size()));
  }
  const auto are_finite = [](const std::vector<double>& values) {
    return std::all_of(values.begin(), values.end(), [](double x) { return std::isfinite(x); });
  };
  if (!are_finite(before) || !are_finite(gains) || !are_finite(random)) {
    return InvalidArgument("returns", "finite numbers", "others");
  }
  for (size_t i = 0; i < gains.size(); ++i) gains[i] -= before[i];
  return LossOf(
      std::accumulate(before.begin(), before.end(), 0.0) / static_cast<double>(before.size()),
      random[0], std::move(gains));
}

RoundingLoss LostAgreement(const Policy& parent, const Policy& rounded,
                           absl::Span<const Episode> episodes) {
  SPIKESERVE_DCHECK(!episodes.empty());
  std::vector<double> losses = Agreements(parent, episodes);
  const std::vector<double> after = Agreements(rounded, episodes);
  for (size_t i = 0; i < losses.size(); ++i) losses[i] -= after[i];
  return {.measure = "agreement", .range = 1.0, .loss = MeanWithInterval(losses)};
}

bool IsTooMuch(const RoundingLoss& loss, double largest) {
  return loss.loss.mean > largest && loss.loss.low > 0.0;
}

absl::Status CheckLoss(const RoundingLoss& loss, double largest, absl::string_view advice) {
  if (!IsTooMuch(loss, largest)) return absl::OkStatus();
  return absl::FailedPreconditionError(
      absl::StrFormat("--max_loss: expected a loss of at most %.3g of the range of the %s, "
                      "received %.3g: %s, or accept the loss by --allow_loss",
                      largest, loss.measure, loss.loss.mean, advice));
}

std::string ToText(const RoundingLoss& loss) {
  return absl::StrFormat(
      "the integers lost %.2f %% of the range of the %s (%s)", Rounded(100.0 * loss.loss.mean, 2),
      loss.measure,
      loss.loss.is_bounded()
          ? absl::StrFormat("95 %%: %.2f to %.2f %%", Rounded(100.0 * loss.loss.low, 2),
                            Rounded(100.0 * loss.loss.high, 2))
          : "one episode has no interval");
}

nlohmann::ordered_json ToJson(const RoundingLoss& loss) {
  return {{"measure", std::string(loss.measure)},
          {"range", loss.range},
          {"share", loss.loss.mean},
          {"share_95_percent", {loss.loss.low, loss.loss.high}}};
}

}  // namespace spikeserve
