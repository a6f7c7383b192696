#include "train/evaluation/calibration.h"

#include <algorithm>
#include <cmath>
#include <memory>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/engine/factory/engine_factory.h"
#include "core/engine/spiking/integer_engine.h"
#include "core/engine/spiking/streaming_engine.h"
#include "core/engine/token.h"
#include "core/environment/environment.h"
#include "train/data/dataset.h"
#include "train/recording/policy_player.h"

namespace spikeserve {
namespace {

// Collects the largest magnitude of the inputs of one policy.
class InputRange {
 public:
  explicit InputRange(const Policy& policy) : policy_(policy) {}

  // Forgets the last observation.
  void StartEpisode() { previous_.clear(); }

  void Add(absl::Span<const float> observation, double return_to_go) {
    SetStateInput(policy_, observation, &previous_, &input_);
    input_.push_back(StandardizeReturn(policy_, static_cast<float>(return_to_go)));
    for (const float value : input_) {
      // The last observation of a recorded episode may be unknown.
      if (std::isfinite(value)) largest_ = std::max(largest_, std::abs(value));
    }
  }

  float largest() const { return largest_; }

 private:
  const Policy& policy_;
  std::vector<float> previous_;  // observation; see SetStateInput
  std::vector<float> input_;
  float largest_ = 1.0f;
};

// Shows the policy all steps of the episodes. Calls `start` with the context of each episode first.
template <class Start>
void Observe(const Policy& policy, absl::Span<const Episode> episodes, const Start& start) {
  const auto engine = MakeEngine(std::make_shared<const Policy>(policy));
  const auto size = static_cast<size_t>(policy.observation_size());
  std::vector<float> encoded(policy.action_space.size());
  Engine::Output output;
  for (const Episode& episode : episodes) {
    const auto context = engine->NewContext();
    start(*context);
    const std::vector<float> returns = ReturnsToGo(episode);
    for (size_t t = 0; t < episode.actions.size(); ++t) {
      engine->Decide(*context, returns[t],
                     absl::MakeConstSpan(episode.observations).subspan(t * size, size), &output);
      policy.action_space.Encode(episode.actions[t], absl::MakeSpan(encoded));
      engine->AppendAction(*context, encoded);
    }
  }
}

}  // namespace

absl::StatusOr<float> LargestInput(const Policy& policy, absl::Span<const Episode> episodes) {
  if (episodes.empty()) {
    return InvalidArgument("calibration", "at least one episode", "none");
  }
  const auto size = static_cast<size_t>(policy.observation_size());
  InputRange range(policy);
  for (const Episode& episode : episodes) {
    const size_t steps = episode.actions.size();
    if (episode.observations.size() != (steps + 1) * size) {
      return InvalidArgument("observation", absl::StrCat(size, " numbers"),
                             episode.observations.size() / (steps + 1));
    }
    const std::vector<float> returns = ReturnsToGo(episode);
    range.StartEpisode();
    for (size_t t = 0; t < steps; ++t) {
      range.Add(absl::MakeConstSpan(episode.observations).subspan(t * size, size), returns[t]);
    }
  }
  return range.largest();
}

absl::StatusOr<std::vector<Episode>> PlayCalibrationEpisodes(const Policy& policy) {
  ASSIGN_OR_RETURN(std::unique_ptr<Environment> environment, MakeEnvironment(policy.environment));
  RETURN_IF_ERROR(CheckSpacesMatch(policy, *environment));
  const auto engine = MakeEngine(std::make_shared<const Policy>(policy));
  std::vector<Episode> episodes(kCalibrationEpisodes);
  for (Episode& episode : episodes) {
    episode.actor = "student";
    episode.seed = kCalibrationSeed + static_cast<uint64_t>(&episode - episodes.data());
    episode.target_return = policy.target_return;
    PolicyPlayer player(*engine, policy.target_return);
    StepResult result;
    result.observation = environment->Reset(episode.seed);
    const auto observe = [&] {
      episode.observations.insert(episode.observations.end(), result.observation.begin(),
                                  result.observation.end());
    };
    observe();
    while (!result.done()) {
      episode.actions.push_back(player.Act(result.observation, result.reward));
      result = environment->Step(episode.actions.back());
      episode.rewards.push_back(result.reward);
      observe();
    }
  }
  return episodes;
}

float LargestResidual(const Policy& policy, absl::Span<const Episode> episodes) {
  SPIKESERVE_DCHECK(!policy.config.is_dense());
  SPIKESERVE_DCHECK(policy.config.arithmetic == Arithmetic::kFloat32);
  float largest = 0.0f;
  Observe(policy, episodes,
          [&](Engine::Context& context) { RecordLargestResidual(context, &largest); });
  return largest;
}

std::vector<std::vector<bool>> FiringHiddenNeurons(const Policy& policy,
                                                   absl::Span<const Episode> episodes) {
  SPIKESERVE_DCHECK(!policy.config.is_dense());
  SPIKESERVE_DCHECK(policy.config.arithmetic == Arithmetic::kInteger);
  const auto layers = static_cast<size_t>(policy.config.layers);
  const auto neurons = static_cast<size_t>(policy.config.ffn_size);
  HiddenSpikes spikes(layers, std::vector<uint64_t>(neurons, 0));
  Observe(policy, episodes,
          [&](Engine::Context& context) { RecordHiddenSpikes(context, &spikes); });
  std::vector<std::vector<bool>> fires;
  for (const std::vector<uint64_t>& layer : spikes) fires.emplace_back(layer.begin(), layer.end());
  return fires;
}

}  // namespace spikeserve
