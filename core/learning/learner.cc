#include "core/learning/learner.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "core/learning/postsynaptic.h"

namespace spikeserve {
namespace {

// gamma of the returns that are judged: those of the target modulator are never discounted, since
// the return-to-go that conditions a decision is not.
double Discount(const LearningOptions& options) {
  return options.modulator == Modulator::kRealized ? options.discount : 1.0;
}

}  // namespace

Learner Learner::New(const LearningOptions& options, const Policy& policy,
                     std::vector<float> head_delta) {
  const Tensor& weight = policy.weights.head.weight;
  Learner learner;
  learner.head_delta = std::move(head_delta);
  if (options.modulator == Modulator::kTarget) {
    const double deviation = static_cast<double>(policy.modulator_std);
    learner.returns = {.mean = static_cast<double>(policy.modulator_mean),
                       .variance = deviation * deviation,
                       .decisions = ReturnStatistics::kMemory};
  }
  if (options.scope == Scope::kSession) learner.guard = ReturnGuard::New(learner.head_delta);
  learner.trace = EligibilityTrace::Zeros(static_cast<size_t>(weight.shape[0]),
                                          static_cast<size_t>(weight.shape[1]));
  learner.StartEpisode(options);
  return learner;
}

std::optional<UpdateOutcome> Learner::OnDecision(const LearningOptions& options,
                                                 const Policy& policy, const ActionChoice& choice,
                                                 absl::Span<const float> readout,
                                                 double return_to_go, double reward) {
  if (suspended) return std::nullopt;
  if (episode.decisions > 0) AddReward(reward);
  episode.AddDecision(Discount(options));
  trace.Update(static_cast<float>(options.trace_decay), PostsynapticActivity(options.rule, choice),
               readout);
  if (options.modulator == Modulator::kTarget) {
    const double modulator = std::clamp(returns.Normalized(return_to_go), -1.0, 1.0);
    const std::vector<double> direction(trace.values.begin(), trace.values.end());
    return Apply(options, policy, options.learning_rate * modulator, direction);
  }
  for (size_t i = 0; i < trace.values.size(); ++i) {
    const auto eligibility = static_cast<double>(trace.values[i]);
    trace_sum[i] += eligibility;
    discounted_trace[i] = options.discount * discounted_trace[i] + eligibility;
  }
  return std::nullopt;
}

std::optional<UpdateOutcome> Learner::OnEpisodeEnd(const LearningOptions& options,
                                                   const Policy& policy, double reward,
                                                   bool terminated) {
  if (suspended || episode.decisions == 0) return std::nullopt;
  AddReward(reward);
  const double discount = Discount(options);
  if (!terminated && discount < 1.0) {
    AddReward(discount / (1.0 - discount) * episode.mean_reward());
  }
  returns.Merge(episode);
  if (options.modulator == Modulator::kTarget) return std::nullopt;

  std::vector<double> direction(trace_sum.size());
  for (size_t i = 0; i < direction.size(); ++i) {
    direction[i] = credit[i] - returns.mean * trace_sum[i];
  }
  const double scale = std::max(returns.deviation(), std::sqrt(episode.SquaresAbout(returns.mean)));
  return Apply(options, policy, options.learning_rate / scale, direction);
}

void Learner::StartEpisode(const LearningOptions& options) {
  trace.Reset();
  episode = {};
  const size_t size = options.modulator == Modulator::kRealized ? head_delta.size() : 0;
  trace_sum.assign(size, 0.0);
  discounted_trace.assign(size, 0.0);
  credit.assign(size, 0.0);
  updates = 0;
  rejected = 0;
  suspended = false;
  if (options.scope == Scope::kFleet) head_delta.assign(head_delta.size(), 0.0f);
}

void Learner::AddReward(double reward) {
  episode.AddReward(reward);
  for (size_t i = 0; i < credit.size(); ++i) credit[i] += reward * discounted_trace[i];
}

UpdateOutcome Learner::Apply(const LearningOptions& options, const Policy& policy, double factor,
                             absl::Span<const double> direction) {
  // What a fleet session gathers has no drift of its own; the fleet's head has its own bounds.
  const double longest =
      options.scope == Scope::kFleet ? options.clip : options.max_drift * BaseNorm(policy);
  const UpdateOutcome outcome =
      ApplyUpdate(factor, direction, {.clip = options.clip, .max_norm = longest}, &head_delta);
  ++(outcome == UpdateOutcome::kApplied ? updates : rejected);
  if (outcome == UpdateOutcome::kNonFinite) trace.Reset();
  return outcome;
}

Linear HeadWith(const Policy& policy, absl::Span<const float> head_delta) {
  Linear head = policy.weights.head;
  for (size_t i = 0; i < head_delta.size(); ++i) head.weight.values[i] += head_delta[i];
  return head;
}

double BaseNorm(const Policy& policy) {
  const double norm = FrobeniusNorm(policy.weights.head.weight.values);
  return norm > 0.0 ? norm : 1.0;
}

}  // namespace spikeserve
