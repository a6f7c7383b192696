#include "core/engine/spike_input.h"

#include "core/neuron/phase.h"

namespace spikeserve {

void SpikeInput::SetPhase(const Policy& policy, int64_t timestep) {
  const ModelConfig& config = policy.config;
  ticks_ = config.ticks;
  phase_members_.clear();
  phase_offsets_.assign(1, 0);
  for (int tick = 0; tick < config.ticks; ++tick) {
    const double time = config.phase_clock == PhaseClock::kWindow
                            ? WindowPhaseTime(tick)
                            : TimestepPhaseTime(timestep, tick, config.ticks);
    for (int k = 0; config.has_phase() && k < config.heads; ++k) {
      if (PhaseSpike(policy.weights.phase_omega.values[k], policy.weights.phase_phi.values[k],
                     time)) {
        phase_members_.push_back(k);
      }
    }
    phase_offsets_.push_back(static_cast<int>(phase_members_.size()));
  }
  phase_spikes_ = phase_members_.size();
}

void SpikeInput::Code(const ModelConfig& config, const Coder& coder, const float* x,
                      const BernoulliKey& key) {
  neurons_ = config.hidden_size;
  periodic_ = config.coder == CoderKind::kLif;
  spikes_.assign(neurons_, 0);
  total_ = 0;
  groups_.clear();
  if (periodic_) {
    CodePeriods(config, coder, x);
  } else {
    CodeBernoulli(coder, x, key);
  }
}

void SpikeInput::CodePeriods(const ModelConfig& config, const Coder& coder, const float* x) {
  periods_.resize(neurons_);
  members_.resize(neurons_);
  kernels::CoderPeriods({config.membrane_decay, config.threshold}, x, coder.gain.values.data(),
                        coder.bias.values.data(), neurons_, ticks_, periods_.data());
  std::vector<int> next(ticks_ + 1, 0);
  for (int j = 0; j < neurons_; ++j) ++next[periods_[j]];
  next[0] = 0;
  int first = 0;
  for (int n = 1; n <= ticks_; ++n) {
    const int count = next[n];
    if (count > 0) groups_.push_back({n, first, count});
    next[n] = first;
    first += count;
  }
  for (int j = 0; j < neurons_; ++j) {
    const int n = periods_[j];
    if (n == 0) continue;
    members_[next[n]++] = j;
    spikes_[j] = ticks_ / n;
    total_ += spikes_[j];
  }
}

void SpikeInput::CodeBernoulli(const Coder& coder, const float* x, const BernoulliKey& key) {
  members_.clear();
  for (int tick = 0; tick < ticks_; ++tick) {
    const int first = static_cast<int>(members_.size());
    for (int j = 0; j < neurons_; ++j) {
      if (!BernoulliSpike(key, j, tick, x[j], coder.gain.values[j], coder.bias.values[j])) continue;
      members_.push_back(j);
      ++spikes_[j];
    }
    const int count = static_cast<int>(members_.size()) - first;
    if (count > 0) groups_.push_back({tick + 1, first, count});
  }
  total_ = members_.size();
}

const kernels::Drive& SpikeInput::DriveOf(const PackedLinear& linear, int width, bool with_phase) {
  sums_.resize(groups_.size() * width);
  for (size_t g = 0; g < groups_.size(); ++g) {
    kernels::SumRows(linear, members_.data() + groups_[g].first, groups_[g].count, width,
                     sums_.data() + g * width);
  }
  drive_.ticks = ticks_;
  drive_.terms.clear();
  drive_.offsets.assign(1, 0);
  for (int tick = 1; tick <= ticks_; ++tick) {
    for (size_t g = 0; g < groups_.size(); ++g) {
      const bool fires = periodic_ ? tick % groups_[g].tick == 0 : tick == groups_[g].tick;
      if (fires) drive_.terms.push_back(sums_.data() + g * width);
    }
    for (int k = phase_offsets_[tick - 1]; with_phase && k < phase_offsets_[tick]; ++k) {
      drive_.terms.push_back(linear.row(neurons_ + phase_members_[k]));
    }
    drive_.offsets.push_back(static_cast<int>(drive_.terms.size()));
  }
  return drive_;
}

uint64_t SpikeInput::Products(const std::vector<uint32_t>& nonzero, bool with_phase) const {
  uint64_t products = 0;
  for (int j = 0; j < neurons_; ++j) products += static_cast<uint64_t>(spikes_[j]) * nonzero[j];
  if (with_phase) {
    for (const int32_t k : phase_members_) products += nonzero[neurons_ + k];
  }
  return products;
}

}  // namespace spikeserve
