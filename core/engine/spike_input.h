// The spikes that flow into a population over the ticks of one token, and the currents they make.
//
// A rate coder's neuron is its period n: it fires at n, 2n, 3n, ... So the rows of all neurons of
// one period are summed once, and at tick t the current is the bias, plus that sum for each period
// dividing t, ascending, plus the rows of the phase spikes at t by head. Bernoulli spikes have no
// period: each tick is summed on its own. Not thread-safe.
#ifndef CORE_ENGINE_SPIKE_INPUT_H_
#define CORE_ENGINE_SPIKE_INPUT_H_

#include <cstdint>
#include <vector>

#include "core/engine/kernels.h"
#include "core/engine/packed_weights.h"
#include "core/model/policy.h"
#include "core/neuron/coder.h"

namespace spikeserve {

class SpikeInput {
 public:
  // Sets the phase spikes of a timestep, shared by its tokens and by all layers.
  void SetPhase(const Policy& policy, int64_t timestep);
  uint64_t phase_spikes() const { return phase_spikes_; }

  // Sets the coder spikes of a token vector x [d].
  void Code(const ModelConfig& config, const Coder& coder, const float* x, const BernoulliKey& key);

  // Coder spikes: of neuron j, and of all neurons.
  int spikes(int j) const { return spikes_[j]; }
  uint64_t total() const { return total_; }

  // The currents into the first `width` lanes of `linear`. Valid until the next call on this
  // object.
  const kernels::Drive& DriveOf(const PackedLinear& linear, int width, bool with_phase);

  // Sum over all spikes of the nonzero weights [inputs] that their neuron meets.
  uint64_t Products(const std::vector<uint32_t>& nonzero, bool with_phase) const;

 private:
  // Neurons whose rows are added together: those of one period, or those that fire at one tick.
  struct Group {
    int tick = 0;  // the period, or the tick itself, 1 ... T
    int first = 0;
    int count = 0;
  };

  void CodePeriods(const ModelConfig& config, const Coder& coder, const float* x);
  void CodeBernoulli(const Coder& coder, const float* x, const BernoulliKey& key);

  int ticks_ = 0;
  int neurons_ = 0;  // d
  bool periodic_ = true;
  uint64_t total_ = 0;
  std::vector<int> spikes_;             // [d]
  std::vector<int32_t> periods_;        // [d]
  std::vector<int32_t> members_;        // neurons by group, ascending inside a group
  std::vector<Group> groups_;           // not empty, ascending by tick
  std::vector<int32_t> phase_members_;  // generators that fire, by tick
  std::vector<int> phase_offsets_;      // [T + 1]
  uint64_t phase_spikes_ = 0;
  std::vector<float> sums_;  // [groups][width]
  kernels::Drive drive_;
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_SPIKE_INPUT_H_
