#include "server/policy_metrics.h"

namespace spikeserve {

void PolicyMetrics::OnDecision(const Answer& answer) {
  const auto add = [](prometheus::Counter* counter, uint64_t count) {
    counter->Increment(static_cast<double>(count));
  };
  const Counts& counts = answer.counts;
  add(handles_.decisions, 1);
  for (size_t i = 0; i < kStages; ++i) add(handles_.spikes[i], counts.spikes_by_stage[i]);
  add(handles_.accumulates, counts.accumulates);
  add(handles_.multiply_accumulates, counts.multiply_accumulates);
  add(handles_.attention_products, counts.attention_products);

  const Energy energy = EstimateEnergy(counts, dense_);
  handles_.spike_5pj->Increment(energy.spike_5pj);
  handles_.horowitz_45nm->Increment(energy.horowitz_45nm);
  handles_.spikes_per_decision->Observe(static_cast<double>(counts.total_spikes()));
  handles_.decision_duration->Observe(answer.compute_seconds);
}

void PolicyMetrics::OnEpisodeEnd(double episode_return) {
  handles_.episodes->Increment();
  handles_.episode_return->Observe(episode_return);
  absl::MutexLock lock(&mutex_);
  ++episodes_;
  return_mean_ += (episode_return - return_mean_) / static_cast<double>(episodes_);
  handles_.episode_return_mean->Set(return_mean_);
}

void PolicyMetrics::OnHeadUpdate(UpdateOutcome outcome) {
  const bool applied = outcome == UpdateOutcome::kApplied;
  (applied ? handles_.learning_updates : handles_.learning_rejected_non_finite)->Increment();
}

}  // namespace spikeserve
