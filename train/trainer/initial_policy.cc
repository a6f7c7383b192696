#include "train/trainer/initial_policy.h"

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

}  // namespace

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
  policy.return_offset = returns.offset;
  policy.return_scale = returns.scale;
  policy.target_return = returns.target;
  policy.modulator_mean = statistics.return_mean();
  policy.modulator_std = statistics.return_std();
  policy.environment = dataset.environment;
  return policy;
}

}  // namespace spikeserve
