#include "train/data/dataset.h"

#include <algorithm>
#include <cmath>
#include <cstddef>

#include "core/contract/dcheck.h"
#include "core/math/vector_view.h"

namespace spikeserve {
namespace {

int64_t MemoryOf(const std::vector<Action>& actions) {
  size_t bytes = actions.size() * sizeof(Action);
  for (const Action& action : actions) bytes += action.continuous.size() * sizeof(float);
  return static_cast<int64_t>(bytes);
}

// Returns the moments of `count` numbers with these sums. The deviation of a constant is 1.
Moments MomentsOf(const Eigen::ArrayXd& sum, const Eigen::ArrayXd& squares, double count) {
  constexpr double kAddedDeviation = 1e-6;
  const Eigen::ArrayXd mean = sum / count;
  const Eigen::ArrayXd deviation = (squares / count - mean.square()).max(0.0).sqrt();
  // The deviation of a constant is what rounding leaves of it. To divide by that would make the
  // entry huge as soon as it changes.
  const Eigen::Array<bool, Eigen::Dynamic, 1> is_constant =
      deviation <= kAddedDeviation * mean.abs().max(1.0);
  const Eigen::ArrayXf deviations =
      is_constant.select(1.0, deviation + kAddedDeviation).cast<float>();
  const Eigen::ArrayXf means = mean.cast<float>();
  return {.mean = {means.begin(), means.end()}, .std = {deviations.begin(), deviations.end()}};
}

}  // namespace

std::vector<float> ReturnsToGo(const Episode& episode) {
  const std::vector<double>& rewards = episode.rewards;
  std::vector<float> returns(rewards.size());
  double sum = 0.0;
  for (size_t i = rewards.size(); i-- > 0;) {
    sum += rewards[i];
    returns[i] = static_cast<float>(sum);
  }
  if (!episode.target_return.has_value()) return returns;
  double left = *episode.target_return;
  for (size_t i = 0; i < rewards.size(); left -= rewards[i++])
    returns[i] = static_cast<float>(left);
  return returns;
}

int64_t MemoryOf(const Episode& episode) {
  const size_t steps = episode.actions.size();
  const size_t arrays = episode.observations.size() * sizeof(float) +
                        episode.weights.size() * sizeof(float) +
                        steps * (sizeof(double) + sizeof(float));  // rewards and returns-to-go
  return static_cast<int64_t>(sizeof(Episode) + arrays) + MemoryOf(episode.actions) +
         MemoryOf(episode.labels);
}

DataStatistics::DataStatistics(int observation_size)
    : sum_(Eigen::ArrayXd::Zero(observation_size)), squares_(sum_), squared_changes_(sum_) {}

void DataStatistics::Add(const Episode& episode) {
  const auto observations = AsMatrix(episode.observations, episode.steps() + 1);
  for (int step = 0; step < episode.steps(); ++step) {
    const auto x = observations.row(step).transpose().array().cast<double>();
    sum_ += x;
    squares_ += x.square();
    const std::vector<float>& label = episode.label(step).continuous;
    if (label_sum_.size() == 0) {
      label_sum_ = label_squares_ = Eigen::ArrayXd::Zero(static_cast<Eigen::Index>(label.size()));
    }
    label_sum_ += AsVector(label).array().cast<double>();
    label_squares_ += AsVector(label).array().cast<double>().square();
    if (step == 0) continue;
    squared_changes_ +=
        (x - observations.row(step - 1).transpose().array().cast<double>()).square();
    ++changes_;
  }
  const std::vector<float> returns_to_go = ReturnsToGo(episode);
  const Eigen::VectorXd returns = AsVector(returns_to_go).cast<double>();
  return_sum_ += returns.sum();
  return_squares_ += returns.squaredNorm();
  best_return_ = steps_ == 0.0 ? returns_to_go[0] : std::max(best_return_, returns_to_go[0]);
  steps_ += episode.steps();
}

Moments DataStatistics::PooledMoments(int groups) const {
  SPIKESERVE_DCHECK_GE(groups, 1);
  SPIKESERVE_DCHECK_EQ(sum_.size() % groups, 0);
  SPIKESERVE_DCHECK(steps_ > 0.0);
  const Eigen::Index in_group = sum_.size() / groups;
  // Entry i of group g is at [g, i] of a column-major matrix.
  const auto pool = [&](const Eigen::ArrayXd& sums) -> Eigen::ArrayXd {
    return Eigen::ArrayXXd::Map(sums.data(), groups, in_group).rowwise().sum();
  };
  const Moments pooled =
      MomentsOf(pool(sum_), pool(squares_), steps_ * static_cast<double>(in_group));
  Moments moments;
  for (Eigen::Index i = 0; i < sum_.size(); ++i) {
    moments.mean.push_back(pooled.mean[i % groups]);
    moments.std.push_back(pooled.std[i % groups]);
  }
  return moments;
}

Moments DataStatistics::labels() const { return MomentsOf(label_sum_, label_squares_, steps_); }

std::vector<float> DataStatistics::change_std() const {
  const Eigen::ArrayXd root = (squared_changes_ / std::max(changes_, 1.0)).sqrt();
  // What rounding leaves of a constant is no change.
  const Eigen::ArrayXd level = (squares_ / steps_).sqrt().max(1.0);
  std::vector<float> scales;
  for (Eigen::Index i = 0; i < root.size(); ++i) {
    scales.push_back(root[i] <= 1e-6 * level[i] ? 1.0f : static_cast<float>(root[i]));
  }
  return scales;
}

float DataStatistics::return_mean() const { return static_cast<float>(return_sum_ / steps_); }

float DataStatistics::return_std() const {
  const double mean = return_sum_ / steps_;
  return static_cast<float>(std::sqrt(std::max(1e-6, return_squares_ / steps_ - mean * mean)));
}

}  // namespace spikeserve
