#include "core/engine/spiking/spike_input.h"

#include <algorithm>
#include <bit>

#include "core/engine/spiking/kernels/event_kernels.h"
#include "core/engine/spiking/kernels/lif_kernels.h"
#include "core/engine/spiking/packed/aligned_vector.h"
#include "core/neuron/phase.h"

namespace spikeserve {

void PhaseSpikes::Set(const Policy& policy, int64_t timestep) {
  const ModelConfig& config = policy.config;
  generators.clear();
  offsets.assign(1, 0);
  for (int tick = 0; tick < config.ticks; ++tick) {
    const double time = config.phase_clock == PhaseClock::kWindow
                            ? WindowPhaseTime(tick)
                            : TimestepPhaseTime(timestep, tick, config.ticks);
    for (int k = 0; config.has_phase() && k < config.heads; ++k) {
      if (PhaseSpike(policy.weights.phase_omega.values[k], policy.weights.phase_phi.values[k],
                     time)) {
        generators.push_back(k);
      }
    }
    offsets.push_back(static_cast<int32_t>(generators.size()));
  }
}

void PhaseSpikes::Set(const std::vector<IntegerPhase>& phases, int ticks, int64_t timestep) {
  generators.clear();
  offsets.assign(1, 0);
  for (int tick = 0; tick < ticks; ++tick) {
    for (size_t k = 0; k < phases.size(); ++k) {
      if (IntegerPhase::Spike(phases[k].At(timestep, static_cast<uint32_t>(tick)))) {
        generators.push_back(static_cast<int32_t>(k));
      }
    }
    offsets.push_back(static_cast<int32_t>(generators.size()));
  }
  firing = generators;
  std::sort(firing.begin(), firing.end());
  firing.erase(std::unique(firing.begin(), firing.end()), firing.end());
}

void SpikeInput::Code(const PackedPeriodCoder& coder, const int16_t* x) {
  ticks_ = coder.ticks;
  neurons_ = coder.neurons;
  periods_.resize(coder.width);
  active_.resize(coder.width / 32);
  kernels::CoderPeriods(coder, x, periods_.data(), active_.data());
  GroupByPeriod();
}

void SpikeInput::Code(const ModelConfig& config, const PeriodTable& periods, const Coder& coder,
                      const float* x) {
  ticks_ = config.ticks;
  neurons_ = config.hidden_size;
  periods_.resize(neurons_);
  active_.resize((neurons_ + 31) / 32);
  kernels::CoderPeriods(periods, x, coder.gain.values.data(), coder.bias.values.data(), neurons_,
                        periods_.data(), active_.data());
  GroupByPeriod();
}

void SpikeInput::GroupByPeriod() {
  total_ = 0;
  groups_.clear();
  members_.resize(neurons_);
  const auto for_each_active = [this](auto visit) {
    for (size_t word = 0; word < active_.size(); ++word) {
      for (uint32_t bits = active_[word]; bits != 0; bits &= bits - 1) {
        visit(static_cast<int32_t>(32 * word) + std::countr_zero(bits));
      }
    }
  };
  AssignZeros(&next_, ticks_ + 1);
  for_each_active([this](int32_t j) { ++next_[periods_[j]]; });
  int first = 0;
  for (int n = 1; n <= ticks_; ++n) {
    const int count = next_[n];
    next_[n] = first;
    if (count == 0) continue;
    groups_.push_back({.period = n, .first = first, .count = count, .spikes = ticks_ / n});
    total_ += static_cast<uint64_t>(count) * groups_.back().spikes;
    first += count;
  }
  for_each_active([this](int32_t j) { members_[next_[periods_[j]]++] = j; });
}

void SpikeInput::Rates(std::vector<float>* rates) const {
  rates->assign(neurons_, 0.0f);
  for (const SpikeGroup& group : groups_) {
    for (int m = group.first; m < group.first + group.count; ++m) {
      (*rates)[members_[m]] += static_cast<float>(group.spikes);  // integers, so the sum is exact
    }
  }
  for (float& rate : *rates) rate /= static_cast<float>(ticks_);
}

uint64_t SpikeInput::SynapsesOf(const SpikeGroup& group, absl::Span<const uint32_t> nonzero) const {
  uint64_t synapses = 0;
  for (int m = group.first; m < group.first + group.count; ++m) synapses += nonzero[members_[m]];
  return synapses;
}

uint64_t SpikeInput::Synapses(absl::Span<const uint32_t> nonzero) const {
  uint64_t synapses = 0;
  for (const SpikeGroup& group : groups_) synapses += SynapsesOf(group, nonzero);
  return synapses;
}

uint64_t SpikeInput::Products(absl::Span<const uint32_t> nonzero, const PhaseSpikes* phase) const {
  uint64_t products = 0;
  for (const SpikeGroup& group : groups_) products += SynapsesOf(group, nonzero) * group.spikes;
  if (phase != nullptr) {
    for (const int32_t k : phase->generators) products += nonzero[neurons_ + k];
  }
  return products;
}

uint64_t SpikeInput::Rows(absl::Span<const uint32_t> nonzero, const PhaseSpikes* phase) const {
  uint64_t rows = Synapses(nonzero);
  if (phase != nullptr) {
    for (const int32_t k : phase->firing) rows += nonzero[neurons_ + k];
  }
  return rows;
}

}  // namespace spikeserve
