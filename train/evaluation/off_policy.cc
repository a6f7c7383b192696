#include "train/evaluation/off_policy.h"

#include <algorithm>
#include <cmath>

#include "Eigen/Cholesky"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

using Matrix = RowMajorMatrix<double>;
using Episodes = std::vector<OffPolicyEpisode>;
using Eigen::Index;
using Eigen::VectorXd;

// Of longer states only the squares are features of Q, not all products.
constexpr Index kMostProducts = 12;
constexpr double kFarthest = 4.0;  // standard deviations; a quadratic Q does not extrapolate
constexpr double kRidge = 1e-3;    // of the second moment of a feature

// Normalizes states and adds their products.
class Features {
 public:
  explicit Features(const std::vector<const OffPolicyEpisode*>& episodes) {
    const Index size = episodes[0]->state.cols();
    VectorXd sum = VectorXd::Zero(size), squares = VectorXd::Zero(size);
    double count = 0.0;
    for (const auto* episode : episodes) {
      sum += episode->state.colwise().sum().transpose();
      squares += episode->state.colwise().squaredNorm().transpose();
      count += static_cast<double>(episode->state.rows());
    }
    mean_ = sum / count;
    deviation_ = (squares / count - mean_.cwiseAbs2()).cwiseMax(0.0).cwiseSqrt();
    for (double& deviation : deviation_) deviation = deviation > 1e-9 ? deviation : 1.0;
  }

  // Returns the features [F] of a state [S].
  VectorXd Of(const VectorXd& state) const {
    const VectorXd x =
        (state - mean_).cwiseQuotient(deviation_).cwiseMax(-kFarthest).cwiseMin(kFarthest);
    const Index size = x.size();
    const bool all = size <= kMostProducts;
    VectorXd features(1 + size + (all ? size * (size + 1) / 2 : size));
    features << 1.0, x, VectorXd::Zero(features.size() - 1 - size);
    Index next = 1 + size;
    for (Index i = 0; i < size; ++i) {
      for (Index j = i; j < (all ? size : i + 1); ++j) features[next++] = x[i] * x[j];
    }
    return features;
  }

 private:
  VectorXd mean_;
  VectorXd deviation_;
};

// A fitted Q: features of the state times a description of the action.
class ActionValue {
 public:
  // Fits Q to the rewards that followed each action, by least squares. That is the Q of the
  // recorded policy, near which a new policy has to be for any estimate. Whatever Q is, the doubly
  // robust estimate is right where the probabilities are; a Q that fits makes its spread smaller.
  explicit ActionValue(const std::vector<const OffPolicyEpisode*>& episodes)
      : features_(episodes), actions_(episodes[0]->taken.cols()) {
    const Index size = features_.Of(episodes[0]->state.row(0)).size() * actions_;
    Eigen::MatrixXd moments = Eigen::MatrixXd::Zero(size, size);
    VectorXd right = VectorXd::Zero(size);
    for (const auto* episode : episodes) {
      const Index steps = episode->state.rows();
      Matrix inputs(steps, size);
      VectorXd returns(steps);
      double following = 0.0;
      for (Index t = steps - 1; t >= 0; --t) {
        returns[t] = following += episode->rewards[static_cast<size_t>(t)];
        AsMatrix(inputs.row(t), size / actions_) =
            features_.Of(episode->state.row(t)) * episode->taken.row(t);
      }
      moments.selfadjointView<Eigen::Lower>().rankUpdate(inputs.transpose());
      right.noalias() += inputs.transpose() * returns;
    }
    moments.diagonal() *= 1.0 + kRidge;
    moments.diagonal().array() += 1e-9;  // of an action that was never taken
    const VectorXd weights = moments.selfadjointView<Eigen::Lower>().ldlt().solve(right);
    weights_ = AsMatrix(weights, size / actions_);
  }

  // Returns what multiplies the description [K] of an action in a state [S] of an episode.
  VectorXd Of(const VectorXd& state) const { return weights_.transpose() * features_.Of(state); }

 private:
  Features features_;
  Index actions_;
  Matrix weights_;  // [F, K]
};

// Per episode and step [T]: Q of the answered action, and its means over the actions of a policy.
struct Values {
  std::vector<VectorXd> taken, recorded, evaluated;
};

Values NoValues(const Episodes& episodes) {
  Values values;
  for (const auto& episode : episodes) {
    values.taken.push_back(VectorXd::Zero(episode.state.rows()));
  }
  values.recorded = values.evaluated = values.taken;
  return values;
}

// Fits one Q to the even units and one to the odd ones, and applies each to the others.
Values FitValues(const Episodes& episodes) {
  Values values = NoValues(episodes);
  for (const size_t fold : {0, 1}) {
    std::vector<const OffPolicyEpisode*> others;
    for (const auto& episode : episodes) {
      if (episode.unit % 2 != fold) others.push_back(&episode);
    }
    if (others.empty()) continue;  // Q = 0: importance sampling
    const ActionValue q(others);
    for (size_t i = 0; i < episodes.size(); ++i) {
      const OffPolicyEpisode& episode = episodes[i];
      if (episode.unit % 2 != fold) continue;
      for (Index t = 0; t < episode.state.rows(); ++t) {
        const VectorXd of = q.Of(episode.state.row(t));
        values.taken[i][t] = episode.taken.row(t).dot(of);
        values.recorded[i][t] = episode.recorded.row(t).dot(of);
        values.evaluated[i][t] = episode.evaluated.row(t).dot(of);
      }
    }
  }
  return values;
}

// Returns the weights of all episodes up to each step, [steps, N], which add up to 1 at every step.
// An episode that has ended keeps its weight.
Matrix NormalizedWeights(const Episodes& episodes) {
  size_t steps = 0;
  for (const auto& episode : episodes) steps = std::max(steps, episode.rewards.size());
  Matrix weights(static_cast<Index>(steps), static_cast<Index>(episodes.size()));
  VectorXd logs = VectorXd::Zero(weights.cols());
  for (Index t = 0; t < weights.rows(); ++t) {
    for (size_t i = 0; i < episodes.size(); ++i) {
      const auto& ratios = episodes[i].log_ratios;
      if (static_cast<size_t>(t) < ratios.size()) logs[static_cast<Index>(i)] += ratios[t];
    }
    const VectorXd scaled = (logs.array() - logs.maxCoeff()).exp();
    weights.row(t) = scaled / scaled.sum();
  }
  return weights;
}

// An estimate of a mean return, and how much each episode moves it: [N], of mean 0.
struct Estimate {
  double value = 0.0;
  VectorXd influence;
};

// `next` is the mean of Q over the actions of the policy that `weights` are for.
Estimate EstimateReturn(const Episodes& episodes, const Matrix& weights,
                        const std::vector<VectorXd>& taken, const std::vector<VectorXd>& next) {
  const Index count = weights.cols();
  Estimate estimate = {.influence = VectorXd::Zero(count)};
  VectorXd before = VectorXd::Constant(count, 1.0 / static_cast<double>(count));
  for (Index t = 0; t < weights.rows(); ++t) {
    VectorXd errors = VectorXd::Zero(count), means = VectorXd::Zero(count);
    for (Index i = 0; i < count; ++i) {
      const auto& rewards = episodes[static_cast<size_t>(i)].rewards;
      if (static_cast<size_t>(t) >= rewards.size()) continue;
      errors[i] = rewards[static_cast<size_t>(t)] - taken[static_cast<size_t>(i)][t];
      means[i] = next[static_cast<size_t>(i)][t];
    }
    const VectorXd now = weights.row(t);
    const double error = now.dot(errors), mean = before.dot(means);
    estimate.value += error + mean;
    estimate.influence.array() +=
        now.array() * (errors.array() - error) + before.array() * (means.array() - mean);
    before = now;
  }
  estimate.influence *= static_cast<double>(count);
  return estimate;
}

// Returns the 0.975-quantile of Student's t (Abramowitz and Stegun, 26.7.5). REQUIRES: n >= 1.
double StudentQuantile(double n) {
  constexpr double kZ = 1.959964;
  constexpr double kZ3 = kZ * kZ * kZ, kZ5 = kZ3 * kZ * kZ;
  return kZ + (kZ3 + kZ) / (4.0 * n) + (5.0 * kZ5 + 16.0 * kZ3 + 3.0 * kZ) / (96.0 * n * n);
}

OffPolicyInterval IntervalOf(const Episodes& episodes, const Estimate& estimate, size_t units,
                             double effective) {
  VectorXd sums = VectorXd::Zero(static_cast<Index>(units));
  for (size_t i = 0; i < episodes.size(); ++i) {
    sums[static_cast<Index>(episodes[i].unit)] += estimate.influence[static_cast<Index>(i)];
  }
  const auto count = static_cast<double>(units);
  const double deviation = std::sqrt(sums.squaredNorm() * count / std::max(count - 1.0, 1.0)) /
                           static_cast<double>(episodes.size());
  const double freedom = std::max(std::min(effective, count) - 1.0, 1.0);
  const double margin = StudentQuantile(freedom) * deviation;
  return {estimate.value, estimate.value - margin, estimate.value + margin};
}

}  // namespace

std::string OffPolicyEvaluation::verdict() const {
  if (!can_tell()) return "cannot tell";
  if (doubly_robust.difference.low > 0.0) return "better";
  return doubly_robust.difference.high < 0.0 ? "worse" : "no clear difference";
}

OffPolicyEvaluation EvaluateOffPolicy(const Episodes& episodes) {
  SPIKESERVE_DCHECK_GE(episodes.size(), 2u);
  const Matrix weights = NormalizedWeights(episodes);
  const auto count = static_cast<double>(episodes.size());
  const Matrix even = Matrix::Constant(weights.rows(), weights.cols(), 1.0 / count);
  OffPolicyEvaluation result = {.episodes = episodes.size()};
  for (const auto& episode : episodes) {
    result.units = std::max(result.units, episode.unit + 1);
    result.recorded_return += AsVector(episode.rewards).sum() / count;
  }
  for (Index t = 0; t < weights.rows(); ++t) {
    result.effective_by_step.push_back(1.0 / weights.row(t).squaredNorm());
  }
  const VectorXd last = weights.row(weights.rows() - 1).transpose() * count;
  result.weights.assign(last.begin(), last.end());
  const auto estimate = [&](const Values& values) {
    const Estimate fresh = EstimateReturn(episodes, weights, values.taken, values.evaluated);
    const Estimate old = EstimateReturn(episodes, even, values.taken, values.recorded);
    const Estimate difference = {fresh.value - old.value, fresh.influence - old.influence};
    const auto interval = [&](const Estimate& of) {
      return IntervalOf(episodes, of, result.units, result.effective());
    };
    return OffPolicyEstimate{interval(fresh), interval(difference)};
  };
  result.importance_sampling = estimate(NoValues(episodes));
  result.doubly_robust = estimate(FitValues(episodes));
  return result;
}

}  // namespace spikeserve
