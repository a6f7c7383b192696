#include "core/learning/learner.h"

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "core/learning/contribution.h"
#include "core/learning/frobenius_norm.h"
#include "core/learning/postsynaptic.h"
#include "core/math/vector_view.h"

namespace spikeserve {
namespace {

// Returns gamma of the returns that enter mu and sigma. The target modulator does not discount
// them, because the return-to-go that conditions a decision is not discounted.
double Discount(const LearningOptions& options) {
  return options.modulator == Modulator::kRealized ? options.discount : 1.0;
}

// Returns the bounds of an update. `max_drift` limits a private head; the shared head has limits of
// its own (FleetOptions).
UpdateBounds BoundsOf(const LearningOptions& options, const Policy& policy) {
  const double longest =
      options.scope == Scope::kFleet ? options.clip : options.max_drift * BaseNorm(policy);
  return {.clip = options.clip, .max_norm = std::min(longest, kLongestHeadDelta)};
}

}  // namespace

Learner Learner::New(const LearningOptions& options, const Policy& policy,
                     Eigen::VectorXf head_delta) {
  Learner learner;
  learner.head_delta = std::move(head_delta);
  if (options.modulator == Modulator::kTarget) {
    const double deviation = static_cast<double>(policy.modulator_std);
    learner.returns = {.mean = static_cast<double>(policy.modulator_mean),
                       .variance = deviation * deviation,
                       .decisions = ReturnStatistics::kMemory};
  }
  if (options.scope == Scope::kSession) learner.guard = ReturnGuard::New(learner.head_delta);
  learner.StartEpisode(options);
  return learner;
}

std::optional<UpdateOutcome> Learner::OnDecision(const LearningOptions& options,
                                                 const Policy& policy, const ActionChoice& choice,
                                                 absl::Span<const float> rates, double return_to_go,
                                                 double reward) {
  if (suspended) return std::nullopt;
  if (options.rule == Rule::kCorrections) {
    if (episode.decisions > 0) AddReward(reward);
    episode.AddDecision(Discount(options));
    post.setZero(static_cast<Eigen::Index>(choice.logits.size()));
    readout = AsVector(rates);
    return std::nullopt;
  }

  thread_local std::vector<float> y;  // reused, so that a decision allocates no memory
  PostsynapticActivity(options.rule, policy.action_space, choice, &y);
  if (kept.has_value() &&
      Keep(options, reward, {.post = y, .readout = {rates.begin(), rates.end()}})) {
    return std::nullopt;
  }
  AddDecision(options, reward, y, rates);
  if (DependsOnAction(options.rule)) {
    post = AsVector(y);
    readout = AsVector(rates);
  }

  if (options.modulator == Modulator::kTarget) {
    if (DependsOnAction(options.rule)) before_update = head_delta;
    return ApplyTarget(options, policy, return_to_go);
  }
  return std::nullopt;
}

void Learner::AddDecision(const LearningOptions& options, double reward,
                          absl::Span<const float> post_y, absl::Span<const float> rates) {
  if (episode.decisions > 0) AddReward(reward);
  episode.AddDecision(Discount(options));
  const auto decay = static_cast<float>(options.trace_decay);
  auto matrix = AsMatrix(trace, static_cast<Eigen::Index>(post_y.size()));
  matrix.noalias() = decay * matrix + AsVector(post_y) * AsVector(rates).transpose();  // eq. 4.1
  if (options.modulator == Modulator::kTarget) return;
  trace_sum += trace.cast<double>();
  discounted_trace = options.discount * discounted_trace + trace.cast<double>();
}

std::optional<UpdateOutcome> Learner::OnExecuted(const LearningOptions& options,
                                                 const Policy& policy,
                                                 const ActionSelection& selection,
                                                 absl::Span<const float> logits,
                                                 const Action& answered, const Action& executed,
                                                 double return_to_go) {
  if (suspended || !DependsOnAction(options.rule) || options.rule == Rule::kCorrections) {
    return std::nullopt;
  }
  const auto replace = [&](std::vector<float> y) {
    ReplaceAction(options.rule, policy.action_space, logits, selection.temperature, answered,
                  executed, absl::MakeSpan(y));
    return y;
  };
  if (kept.has_value()) {
    if (kept->steps.empty()) return std::nullopt;
    StepFactors& last = kept->steps.back();
    if (last.executed.empty() && !last.post.empty()) last.executed = replace(last.post);
    return std::nullopt;
  }
  if (post.size() == 0) return std::nullopt;
  const Eigen::VectorXf y = std::exchange(post, {});
  ChangeAction({y.data(), static_cast<size_t>(y.size())}, replace({y.begin(), y.end()}),
               {readout.data(), static_cast<size_t>(readout.size())});
  if (options.modulator == Modulator::kRealized) return std::nullopt;
  head_delta = before_update;
  --updates;
  return ApplyTarget(options, policy, return_to_go);
}

void Learner::ChangeAction(absl::Span<const float> from, absl::Span<const float> to,
                           absl::Span<const float> rates) {
  Eigen::VectorXf change(head_delta.size());
  AsMatrix(change, static_cast<Eigen::Index>(from.size())).noalias() =
      (AsVector(to) - AsVector(from)) * AsVector(rates).transpose();
  trace += change;
  if (trace_sum.size() == 0) return;  // kTarget
  trace_sum += change.cast<double>();
  discounted_trace += change.cast<double>();
}

std::optional<UpdateOutcome> Learner::OnOperator(const LearningOptions& options,
                                                 const Policy& policy,
                                                 absl::Span<const float> logits,
                                                 const OperatorStep& step,
                                                 const Eigen::VectorXf& start_delta) {
  if (suspended || post.size() == 0 || options.rule != Rule::kCorrections) return std::nullopt;
  const Corrections before = corrections;
  const Action& executed = step.executed;
  ++corrections.steps;
  const bool in_fleet = options.scope == Scope::kFleet;
  if (corrections.in_episode++ == 0 && !in_fleet) guard.OnTaught(head_delta);
  const auto act = static_cast<Eigen::Index>(logits.size());
  post.resize(0);
  // A fleet's head answered without what this episode has learned.
  if (in_fleet) NoteOperator(step.operator_id);
  Eigen::VectorXf learned = head_delta;
  if (!in_fleet && start_delta.size() > 0) learned -= start_delta;
  const Eigen::VectorXf change = AsMatrix(learned, act) * readout;
  Eigen::VectorXf now = AsVector(logits);
  Eigen::VectorXf start = now;
  in_fleet ? now += change : start -= change;

  const Eigen::VectorXf target = Target(policy.action_space, executed);
  const Eigen::VectorXf at_start = Prediction(policy.action_space, start);
  const Eigen::VectorXf error = target - Prediction(policy.action_space, now);
  corrections.Measure(error.squaredNorm(), (target - at_start).squaredNorm(),
                      target.squaredNorm() + at_start.squaredNorm());
  if (corrections.DoesHarm()) {
    head_delta -= learned;
    corrections.PutBack();
    runs = {};
    if (!in_fleet) ++guard.rollbacks;
    return UpdateOutcome::kApplied;
  }
  const float energy = readout.squaredNorm();
  if (energy == 0.0f || AgreesWith(policy.action_space, now, executed)) return std::nullopt;
  Eigen::VectorXf direction(head_delta.size());
  AsMatrix(direction, act).noalias() = error * readout.transpose();
  const double rate = options.learning_rate * corrections.Weight();
  if (!in_fleet) runs.Add(step.operator_id, step.time, head_delta, before);
  return Apply(options, policy, rate / static_cast<double>(energy), direction);
}

void Learner::NoteOperator(absl::string_view operator_id) {
  if (operators.size() == Contribution::kMostOperators) return;
  if (std::find(operators.begin(), operators.end(), operator_id) != operators.end()) return;
  operators.emplace_back(operator_id);
}

std::optional<int64_t> Learner::UndoCorrections(const LearningOptions& options,
                                                const Policy& policy, absl::string_view operator_id,
                                                double since) {
  const auto undone = runs.Undo(operator_id, since, &head_delta, &corrections);
  if (undone.value_or(0) == 0) return undone;
  // The sum of the others' changes may be longer than what was left of them all.
  ApplyUpdate(0.0, head_delta, BoundsOf(options, policy), &head_delta);
  const int64_t rollbacks = guard.rollbacks;
  guard = ReturnGuard::New(head_delta);
  guard.rollbacks = rollbacks;
  return undone;
}

UpdateOutcome Learner::ApplyTarget(const LearningOptions& options, const Policy& policy,
                                   double return_to_go) {
  const double modulator = std::clamp(returns.Normalized(return_to_go), -1.0, 1.0);
  return Apply(options, policy, options.learning_rate * modulator, trace);
}

void Learner::OnSkipped(const LearningOptions& options, double reward) {
  if (suspended || (kept.has_value() && Keep(options, reward, {}))) return;
  AddGap(options, reward);
}

void Learner::AddGap(const LearningOptions& options, double reward) {
  if (episode.decisions == 0) return;
  AddReward(reward);
  episode.AddGap(Discount(options));
  trace *= static_cast<float>(options.trace_decay);
  discounted_trace *= options.discount;
  post.resize(0);  // the executed action of the last decision comes too late
}

std::optional<UpdateOutcome> Learner::OnEpisodeEnd(const LearningOptions& options,
                                                   const Policy& policy, double reward,
                                                   bool terminated) {
  if (suspended) return std::nullopt;
  if (kept.has_value()) Replay(options, *std::exchange(kept, std::nullopt));
  if (episode.decisions == 0) return std::nullopt;
  AddReward(reward);
  const double discount = Discount(options);
  if (!terminated && discount < 1.0) {
    AddReward(discount / (1.0 - discount) * episode.mean_reward());
  }
  returns.Merge(episode);
  const bool learns_at_end =
      options.modulator == Modulator::kRealized && options.rule != Rule::kCorrections;
  if (!learns_at_end) return std::nullopt;

  const Eigen::VectorXd direction = credit - returns.mean * trace_sum;
  const double scale = std::max(returns.deviation(), std::sqrt(episode.SquaresAbout(returns.mean)));
  return Apply(options, policy, options.learning_rate / scale, direction);
}

bool Learner::Keep(const LearningOptions& options, double reward, StepFactors step) {
  if (kept_steps() < kMostKept) {
    kept->Add(reward, std::move(step));
    return true;
  }
  Replay(options, *std::exchange(kept, std::nullopt));
  return false;
}

void Learner::Replay(const LearningOptions& options, const EpisodeFactors& factors) {
  for (size_t i = 0; i < factors.steps.size(); ++i) {
    const StepFactors& step = factors.steps[i];
    const double reward = i == 0 ? 0.0 : factors.rewards[i - 1];
    if (step.post.empty()) {
      AddGap(options, reward);
      continue;
    }
    AddDecision(options, reward, step.post, step.readout);
    if (!step.executed.empty()) ChangeAction(step.post, step.executed, step.readout);
  }
}

bool Learner::AwaitVerdict(double reward, WaitingEpisode ended) {
  if (suspended || !kept.has_value() || waiting.size() >= kMostWaiting) return false;
  ended.factors = *std::exchange(kept, std::nullopt);
  ended.factors.rewards.push_back(reward);
  waiting.push_back(std::make_shared<const WaitingEpisode>(std::move(ended)));
  return true;
}

void Learner::Recall(const LearningOptions& options, const EpisodeFactors& factors) {
  StartEpisode(options);
  kept.reset();
  Replay(options, factors);
}

size_t Learner::kept_steps() const {
  size_t steps = kept.has_value() ? kept->steps.size() : 0;
  for (const auto& ended : waiting) steps += ended->factors.steps.size();
  return steps;
}

void Learner::StartEpisode(const LearningOptions& options) {
  trace.setZero(head_delta.size());
  episode = {};
  const Eigen::Index size = options.modulator == Modulator::kRealized ? head_delta.size() : 0;
  trace_sum.setZero(size);
  discounted_trace.setZero(size);
  credit.setZero(size);
  updates = 0;
  rejected = 0;
  suspended = false;
  post.resize(0);
  corrections.in_episode = 0;
  operators.clear();
  kept.reset();
  if (options.verdict_seconds > 0.0) kept.emplace();
  if (options.scope == Scope::kFleet) head_delta.setZero();
}

void Learner::AddReward(double reward) {
  episode.AddReward(reward);
  credit += reward * discounted_trace;
}

template <typename Direction>
UpdateOutcome Learner::Apply(const LearningOptions& options, const Policy& policy, double factor,
                             const Direction& direction) {
  const UpdateOutcome outcome =
      ApplyUpdate(factor, direction, BoundsOf(options, policy), &head_delta);
  ++(outcome == UpdateOutcome::kApplied ? updates : rejected);
  if (outcome != UpdateOutcome::kApplied) post.resize(0);  // there is no update to replace
  if (outcome == UpdateOutcome::kNonFinite) trace.setZero();
  return outcome;
}

Linear HeadWith(const Policy& policy, const Eigen::VectorXf& head_delta) {
  Linear head;
  HeadWith(policy, head_delta, &head);
  return head;
}

void HeadWith(const Policy& policy, const Eigen::VectorXf& head_delta, Linear* head) {
  *head = policy.weights.head;
  AsVector(head->weight.values) += head_delta;
}

double BaseNorm(const Policy& policy) {
  const double norm = FrobeniusNorm(AsVector(policy.weights.head.weight.values));
  return norm > 0.0 ? norm : 1.0;
}

}  // namespace spikeserve
