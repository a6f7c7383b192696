#include "core/learning/learner.h"

#include <algorithm>
#include <cmath>

#include "core/learning/postsynaptic.h"

namespace spikeserve {
namespace {

// What drift is measured against.
double BaseNorm(const Policy& policy) {
  const double norm = FrobeniusNorm(policy.weights.head.weight.values);
  return norm > 0.0 ? norm : 1.0;
}

}  // namespace

Learner Learner::New(const LearningOptions& options, const Policy& policy) {
  const Tensor& weight = policy.weights.head.weight;
  const double deviation = static_cast<double>(policy.modulator_std);
  Learner learner;
  learner.head_delta.assign(weight.values.size(), 0.0f);
  learner.returns = {.mean = static_cast<double>(policy.modulator_mean),
                     .variance = deviation * deviation};
  learner.trace = EligibilityTrace::Zeros(static_cast<size_t>(weight.shape[0]),
                                          static_cast<size_t>(weight.shape[1]));
  learner.StartEpisode(options);
  return learner;
}

std::optional<UpdateOutcome> Learner::OnDecision(const LearningOptions& options,
                                                 const Policy& policy, const ActionChoice& choice,
                                                 absl::Span<const float> readout,
                                                 double return_to_go, double rewards) {
  trace.Update(static_cast<float>(options.trace_decay), PostsynapticActivity(options.rule, choice),
               readout);
  rewards_before.Add(rewards);
  if (options.modulator == Modulator::kTarget) {
    const double modulator = std::clamp(returns.Normalized(return_to_go), -1.0, 1.0);
    const std::vector<double> direction(trace.values.begin(), trace.values.end());
    return Apply(options, policy, options.learning_rate * modulator, direction);
  }
  for (size_t i = 0; i < trace.values.size(); ++i) {
    trace_sum[i] += static_cast<double>(trace.values[i]);
    weighted_sum[i] += rewards * static_cast<double>(trace.values[i]);
  }
  return std::nullopt;
}

std::optional<UpdateOutcome> Learner::OnEpisodeEnd(const LearningOptions& options,
                                                   const Policy& policy, double episode_return) {
  std::optional<UpdateOutcome> outcome;
  if (options.modulator == Modulator::kRealized) {
    const double first = episode_return - returns.mean;  // G_t - mu is first - c_t
    std::vector<double> direction(trace_sum.size());
    for (size_t i = 0; i < direction.size(); ++i) {
      direction[i] = first * trace_sum[i] - weighted_sum[i];
    }
    const double largest =
        std::max(std::abs(first - rewards_before.least), std::abs(first - rewards_before.most));
    // sigma s = max(sigma, max_t |G_t - mu|)
    const double scale = std::max(returns.deviation(), largest);
    outcome = Apply(options, policy, options.learning_rate / scale, direction);
  }
  returns.Merge(rewards_before, episode_return);
  return outcome;
}

void Learner::StartEpisode(const LearningOptions& options) {
  trace.Reset();
  rewards_before = {};
  const size_t size = options.modulator == Modulator::kRealized ? head_delta.size() : 0;
  trace_sum.assign(size, 0.0);
  weighted_sum.assign(size, 0.0);
  updates = 0;
  rejected = 0;
}

UpdateOutcome Learner::Apply(const LearningOptions& options, const Policy& policy, double factor,
                             absl::Span<const double> direction) {
  const UpdateBounds bounds = {.clip = options.clip,
                               .max_norm = options.max_drift * BaseNorm(policy)};
  const UpdateOutcome outcome = ApplyUpdate(factor, direction, bounds, &head_delta);
  ++(outcome == UpdateOutcome::kApplied ? updates : rejected);
  if (outcome == UpdateOutcome::kNonFinite) trace.Reset();
  return outcome;
}

Linear Learner::Head(const Policy& policy) const {
  Linear head = policy.weights.head;
  for (size_t i = 0; i < head_delta.size(); ++i) head.weight.values[i] += head_delta[i];
  return head;
}

double Learner::Drift(const Policy& policy) const {
  return FrobeniusNorm(head_delta) / BaseNorm(policy);
}

}  // namespace spikeserve
