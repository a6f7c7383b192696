#include "train/trainer/initial_policy.h"

#include "core/math/vector_view.h"
#include "train/trainer/return_scaling.h"

namespace spikeserve {
namespace {

// Returns the scaling of the source's environment. For an environment without one, returns the
// moments of the returns-to-go and the best return in the data.
ReturnScaling ScalingOf(const EpisodeSource& source) {
  if (const auto scaling = ReturnScalingOf(source.dataset().environment); scaling.ok()) {
    return *scaling;
  }
  const DataStatistics& statistics = source.statistics();
  return {.offset = statistics.return_mean(),
          .scale = statistics.return_std(),
          .target = statistics.best_return()};
}

// Makes the action embedding standardise its input, and the head's output have these moments.
void FitToLabels(const Moments& labels, Policy* policy) {
  constexpr float kLargestMean = 0.95f;  // tanh is flat beyond
  Linear& embedding = policy->weights.embed_action.linear;
  Linear& head = policy->weights.head;
  const auto act = static_cast<Eigen::Index>(labels.mean.size());
  const auto mean = AsVector(labels.mean), deviation = AsVector(labels.std);
  auto action_weight = AsMatrix(embedding.weight.values, policy->config.hidden_size);
  action_weight = action_weight * deviation.cwiseInverse().asDiagonal();
  AsVector(embedding.bias.values) -= action_weight * mean;
  auto head_weight = AsMatrix(head.weight.values, act);
  head_weight = deviation.asDiagonal() * head_weight;
  AsVector(head.bias.values) =
      mean.cwiseMax(-kLargestMean).cwiseMin(kLargestMean).array().atanh().matrix();
}

}  // namespace

Moments EncodedLabels(const EpisodeSource& source) {
  Moments labels = source.statistics().labels();
  const ActionSpace& space = source.dataset().action_space;
  for (size_t i = 0; i < labels.mean.size(); ++i) {
    const float half = (space.high[i] - space.low[i]) / 2.0f;
    labels.mean[i] = (labels.mean[i] - space.low[i]) / half - 1.0f;
    labels.std[i] /= half;
  }
  return labels;
}

Policy InitialPolicy(const ModelConfig& config, const EpisodeSource& source, uint64_t seed,
                     const PatchShape& patches) {
  const Dataset& dataset = source.dataset();
  Policy policy = RandomPolicy(config, dataset.observation_size, dataset.action_space, seed);
  const ReturnScaling returns = ScalingOf(source);
  const DataStatistics& statistics = source.statistics();
  const Moments moments =
      patches.used() ? statistics.PooledMoments(patches.channels) : statistics.observations();
  policy.weights.observation_mean.values = moments.mean;
  policy.weights.observation_std.values = moments.std;
  if (config.observation_changes) {
    policy.weights.observation_change_std.values = statistics.change_std();
  }
  policy.return_offset = returns.offset;
  policy.return_scale = returns.scale;
  policy.target_return = returns.target;
  policy.modulator_mean = statistics.return_mean();
  policy.modulator_std = statistics.return_std();
  policy.environment = dataset.environment;
  if (!dataset.action_space.is_discrete()) FitToLabels(EncodedLabels(source), &policy);
  return policy;
}

}  // namespace spikeserve
