#include "server/metrics/policy_metrics.h"

#include <algorithm>

#include "absl/strings/str_cat.h"
#include "server/base/log.h"

namespace spikeserve {
namespace {

constexpr double kUsualReturnScales = 3.0;

}  // namespace

UsualObservations UsualObservations::Of(const Policy& policy, double deviations) {
  UsualObservations usual;
  if (deviations == 0.0) return usual;
  const std::vector<float>& mean = policy.weights.observation_mean.values;
  const std::vector<float>& deviation = policy.weights.observation_std.values;
  for (size_t i = 0; i < mean.size(); ++i) {
    const double reach = deviations * static_cast<double>(deviation[i]);
    usual.low.push_back(static_cast<float>(mean[i] - reach));
    usual.high.push_back(static_cast<float>(mean[i] + reach));
  }
  const auto [least, most] = std::minmax(policy.return_offset, policy.target_return);
  const double reach = kUsualReturnScales * static_cast<double>(policy.return_scale);
  usual.low_return = static_cast<double>(least) - reach;
  usual.high_return = static_cast<double>(most) + reach;
  return usual;
}

uint32_t PolicyMetrics::CountUnusual(absl::Span<const float> observation, double return_to_go) {
  uint32_t total = 0;
  for (size_t i = 0; i < usual_.low.size(); ++i) {
    if (observation[i] >= usual_.low[i] && observation[i] <= usual_.high[i]) continue;
    ++total;
    const auto& unusual = series_.get().unusual;
    unusual[i * unusual.size() / usual_.low.size()]->Increment();
  }
  if (return_to_go < usual_.low_return || return_to_go > usual_.high_return) {
    ++total;
    series_.get().unusual_return->Increment();
  }
  return total;
}

void PolicyMetrics::OnBeat(const Answer& answer) {
  CountWork(answer);
  robots_.get().appended->Increment();
}

void PolicyMetrics::OnSkippedBeats(int64_t beats) {
  robots_.get().skipped->Increment(static_cast<double>(beats));
}

void PolicyMetrics::OnReport(const BeatCounts& beats) {
  const RobotHandles& handles = robots_.get();
  const uint64_t by_source[] = {beats.fresh, beats.held, beats.local, beats.safe};
  for (size_t i = 0; i < handles.beats.size(); ++i) {
    handles.beats[i]->Increment(static_cast<double>(by_source[i]));
  }
  handles.late_answers->Increment(static_cast<double>(beats.late_answers));
  handles.cancelled_calls->Increment(static_cast<double>(beats.cancelled_calls));
  handles.reconnects->Increment(static_cast<double>(beats.reconnects));
  handles.invalid_observations->Increment(static_cast<double>(beats.invalid_observations));
  const bool is_news = beats.fresh + beats.held + beats.local + beats.safe > 0;
  if (is_news && beats.oldest_age_seconds > 0.0) handles.age->Observe(beats.oldest_age_seconds);
  if (is_news && beats.longest_gap_seconds > 0.0) handles.gap->Observe(beats.longest_gap_seconds);
}

void PolicyMetrics::OnDecision(const Answer& answer) {
  const Handles& handles = series_.get();
  handles.decisions->Increment();
  CountWork(answer);
  handles.spikes_per_decision->Observe(static_cast<double>(answer.counts.total_spikes()));
  handles.decision_duration->Observe(answer.compute_seconds);
}

void PolicyMetrics::CountWork(const Answer& answer) {
  const auto add = [](prometheus::Counter* counter, uint64_t count) {
    counter->Increment(static_cast<double>(count));
  };
  const Counts& counts = answer.counts;
  const Handles& handles = series_.get();
  for (size_t i = 0; i < kStages; ++i) add(handles.spikes[i], counts.spikes_by_stage[i]);
  add(handles.accumulates, counts.accumulates);
  add(handles.multiply_accumulates, counts.multiply_accumulates);
  add(handles.attention_products, counts.attention_products);
  add(handles.membrane_updates, counts.membrane_updates);
  add(handles.coder_gains, counts.coder_gains);
  add(handles.layer_norm_elements, counts.layer_norm_elements);
  add(handles.softmax_terms, counts.softmax_terms);
  add(handles.gate_products, counts.gate_products);

  for (int i = 0; i < kEnergyModels; ++i) {
    const auto joules = EstimateEnergy(static_cast<EnergyModel>(i), counts, config_);
    if (joules.has_value()) handles.energy[static_cast<size_t>(i)]->Increment(*joules);
  }
}

void PolicyMetrics::OnNonFinite() {
  loaded_.non_finite->Increment();
  LogError("answer not finite", {{"policy", name_}});
}

void PolicyMetrics::OnWiring(const std::string& id, WiringCause cause, const std::string& text,
                             WiringResponse response) {
  series_.get().wiring[static_cast<size_t>(cause)]->Increment();
  if (response == WiringResponse::kCount) return;
  LogWarning("robot looks miswired", {{"policy", name_}, {"session", id}, {"verdict", text}});
}

void PolicyMetrics::OnEpisodeEnd(double episode_return) {
  const Handles& handles = series_.get();
  handles.episodes->Increment();
  if (!plausible_.Contain(episode_return)) return OnImplausible();
  handles.episode_return->Observe(episode_return);
  absl::MutexLock lock(&mutex_);
  ++returns_;
  return_mean_ += (episode_return - return_mean_) / static_cast<double>(returns_);
  handles.episode_return_mean->Set(return_mean_);
}

void PolicyMetrics::OnHeadUpdate(UpdateOutcome outcome) {
  switch (outcome) {
    case UpdateOutcome::kApplied:
      return series_.get().learning_updates->Increment();
    case UpdateOutcome::kNonFinite:
      return series_.get().learning_rejected_non_finite->Increment();
    case UpdateOutcome::kOverBudget:
      return series_.get().learning_rejected_over_budget->Increment();
    case UpdateOutcome::kHeldOut:
      return series_.get().learning_rejected_held_out->Increment();
  }
}

void PolicyMetrics::OnLearned(const LearningSummary& summary) {
  const LearningHandles& handles = series_.get().learning[static_cast<size_t>(summary.scope)];
  handles.head_drift->Set(summary.head_drift);
  // Agents choose the rewards.
  handles.modulator_mean->Set(std::clamp(summary.returns.mean, plausible_.low, plausible_.high));
  handles.modulator_std->Set(
      std::min(summary.returns.deviation(), plausible_.high - plausible_.low));
  handles.watched_return->Set(std::clamp(summary.watched_return, plausible_.low, plausible_.high));
  if (!summary.rolled_back) return;
  handles.rollbacks->Increment();
  LogWarning("action head rolled back", {{"policy", name_},
                                         {"scope", ToString(summary.scope)},
                                         {"watched_return", absl::StrCat(summary.watched_return)}});
}

}  // namespace spikeserve
