// The terms of a current are added in a fixed order. A wrong order rarely changes a spike, so these
// tests compare the currents.
#include "core/engine/spiking/spike_input.h"

#include <gtest/gtest.h>

#include "core/engine/spiking/drive_builder.h"
#include "core/engine/spiking/packed/packed_linear.h"
#include "core/math/counter_random.h"
#include "core/neuron/lif.h"
#include "core/neuron/phase.h"

namespace spikeserve {
namespace {

constexpr int64_t kTimestep = 17;

class SpikeInputTest : public testing::Test {
 protected:
  SpikeInputTest() {
    policy_ = RandomPolicy(config_, 4, ActionSpace::Discrete(2), 5);
    for (int j = 0; j < config_.hidden_size; ++j) {
      x_.push_back(4.0f * UniformFloat(RandomBits({9, static_cast<uint64_t>(j)})) - 1.0f);
    }
    phase_.Set(policy_, kTimestep);
    input_.Code(config_, PeriodTable(Lif(), config_.ticks), Coder(), x_.data());
  }

  const struct Coder& Coder() const { return policy_.weights.layers[0].coder; }

  int Period(int j) const {
    return Lif().Period(x_[j] * Coder().gain.values[j] + Coder().bias.values[j], config_.ticks);
  }

  // Returns the current into output i, added up in the canonical order: the bias; then one sum for
  // the neurons of each period that divides the tick; then the phase spikes one by one.
  float Current(const Linear& linear, int i, int tick) const {
    float current = linear.bias.values[i];
    for (int n = 1; n <= tick; ++n) {
      if (tick % n != 0) continue;
      float group = 0.0f;
      for (int j = 0; j < config_.hidden_size; ++j) {
        if (Period(j) == n) group += linear.weight.at(i, j);
      }
      current += group;
    }
    for (int k = 0; k < config_.heads; ++k) {
      const double time = TimestepPhaseTime(kTimestep, tick - 1, config_.ticks);
      if (PhaseSpike(policy_.weights.phase_omega.values[k], policy_.weights.phase_phi.values[k],
                     time)) {
        current += linear.weight.at(i, config_.hidden_size + k);
      }
    }
    return current;
  }

  ModelConfig config_;
  Policy policy_;
  std::vector<float> x_;
  PhaseSpikes phase_;
  SpikeInput input_;
};

TEST_F(SpikeInputTest, CurrentsAddUpInTheCanonicalOrder) {
  const Linear& key = policy_.weights.layers[0].key;
  const PackedLinear packed = Pack({&key});
  DriveBuilder<float> builder;
  const kernels::Drive<float>& drive = builder.Build(input_, packed, packed.width, &phase_);
  for (int tick = 1; tick <= config_.ticks; ++tick) {
    for (int i = 0; i < config_.hidden_size; ++i) {
      float current = packed.bias[i];
      for (int k = drive.offsets[tick - 1]; k < drive.offsets[tick]; ++k)
        current += drive.terms[k][i];
      ASSERT_EQ(current, Current(key, i, tick)) << "tick " << tick << ", output " << i;
    }
  }
}

}  // namespace
}  // namespace spikeserve
