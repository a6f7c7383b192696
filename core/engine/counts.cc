#include "core/engine/counts.h"

#include <numeric>

namespace spikeserve {
namespace {

constexpr double kPicojoule = 1e-12;
constexpr double kSpikePicojoules = 5.0;       // the paper, section 5.2
constexpr double kAccumulatePicojoules = 0.9;  // Horowitz, ISSCC 2014: FP32 add, 45 nm, 0.9 V
constexpr double kMultiplyAccumulatePicojoules = 4.6;  // FP32 multiply 3.7 and add 0.9

}  // namespace

uint64_t Counts::total_spikes() const {
  return std::accumulate(spikes_by_stage.begin(), spikes_by_stage.end(), uint64_t{0});
}

Counts& Counts::operator+=(const Counts& other) {
  for (int i = 0; i < kStages; ++i) spikes_by_stage[i] += other.spikes_by_stage[i];
  accumulates += other.accumulates;
  multiply_accumulates += other.multiply_accumulates;
  attention_products += other.attention_products;
  return *this;
}

Energy EstimateEnergy(const Counts& counts, bool dense) {
  const double adds =
      static_cast<double>(counts.accumulates + (dense ? 0 : counts.attention_products));
  const double multiplies =
      static_cast<double>(counts.multiply_accumulates + (dense ? counts.attention_products : 0));
  return {.spike_5pj = kSpikePicojoules * kPicojoule * static_cast<double>(counts.total_spikes()),
          .horowitz_45nm = kPicojoule * (kAccumulatePicojoules * adds +
                                         kMultiplyAccumulatePicojoules * multiplies)};
}

}  // namespace spikeserve
