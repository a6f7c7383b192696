#include "core/engine/energy.h"

namespace spikeserve {
namespace {

constexpr double kPicojoule = 1e-12;

// Prices of one arithmetic, in picojoules.
struct Prices {
  double accumulate;                  // of a weight, for one spike
  double weight_multiply_accumulate;  // with a weight of a spike-driven map
  double population_update;           // of the membrane of a query, key, value or hidden neuron
};

// Horowitz, ISSCC 2014, figure 1.1.9: 45 nm, 0.9 V.
constexpr double kFloatAdd = 0.9;
constexpr double kFloatMultiply = 3.7;
constexpr double kFloatMultiplyAccumulate = kFloatMultiply + kFloatAdd;
constexpr Prices kFloat32 = {.accumulate = kFloatAdd,
                             .weight_multiply_accumulate = kFloatMultiplyAccumulate,
                             .population_update = kFloatMultiplyAccumulate};
// The table has no 16-bit integers, so their membranes cost what 32-bit ones cost (multiply 3.1,
// add 0.1): an upper bound.
constexpr Prices kInt8 = {
    .accumulate = 0.03, .weight_multiply_accumulate = 0.23, .population_update = 3.2};

// A LayerNorm adds each element to the mean, subtracts the mean, squares and adds, multiplies by
// the inverse deviation, multiplies by a weight and adds a bias.
constexpr double kLayerNormElement = 2 * kFloatAdd + kFloatMultiply + 2 * kFloatMultiplyAccumulate;
// A term of a softmax is scaled, subtracted from the best one, added to the sum and divided by it.
constexpr double kSoftmaxTerm = 2 * kFloatMultiplyAccumulate;

// Davies et al., IEEE Micro 38(1), 2018, table 2.
constexpr double kLoihiSynapticOperation = 23.6;
constexpr double kLoihiActiveUpdate = 81.0;
constexpr double kLoihiInactiveUpdate = 52.0;
constexpr double kLoihiSpike = 1.7;

constexpr double kPaperSpike = 5.0;  // the paper, section 5.2

constexpr std::array<EnergyModelInfo, kEnergyModels> kInfos = {{
    {.counts = "0.9 pJ an accumulate, 4.6 pJ a multiply-accumulate, a membrane update, a coder "
               "gain and a gate product, 14.7 pJ an element of a LayerNorm, 9.2 pJ a term of a "
               "softmax; an attention product is an accumulate, in a dense policy a "
               "multiply-accumulate",
     .leaves_out = "memory and data movement, control, additions of biases and residuals, "
                   "exponentials, roots, divisions, the phase generators, the action head's "
                   "softmax or tanh",
     .applies_to = "every policy; one in int8 or integer is priced as if it were float32",
     .source = "Horowitz, ISSCC 2014: 45 nm, 0.9 V, float32"},
    {.counts = "0.03 pJ an accumulate, 0.23 pJ a multiply-accumulate with an 8-bit weight, 3.2 pJ "
               "a 16-bit membrane update; coders, attention, routing, LayerNorm, embeddings and "
               "the head as in horowitz_45nm",
     .leaves_out = "what horowitz_45nm leaves out",
     .applies_to = "policies in int8",
     .source = "Horowitz, ISSCC 2014: 45 nm, 0.9 V, integers; 16 bits at the price of 32"},
    {.counts = "23.6 pJ a synaptic operation, 81 pJ a membrane update with a spike and 52 pJ one "
               "without, 1.7 pJ a spike; these prices include the core's memory",
     .leaves_out = "everything that stays on a host (attention products, coder gains, LayerNorm, "
                   "softmax, gate products), spikes between tiles, input and output, static power",
     .applies_to = "policies in int8: a weight has at most 9 bits there",
     .source = "Davies et al., IEEE Micro 38(1), 2018, table 2: pre-silicon simulation"},
    {.counts = "5 pJ a spike",
     .leaves_out = "everything but spikes: synapses, membranes, attention, memory",
     .applies_to = "spiking policies",
     .source = "the paper, section 5.2"},
}};

double Horowitz(const Counts& counts, const ModelConfig& config, const Prices& prices) {
  const auto number = [](uint64_t count) { return static_cast<double>(count); };
  // The neurons of coders stay in float32. A Bernoulli coder has none.
  // Those of integer arithmetic look their period up.
  const bool has_coder_neurons =
      config.coder == CoderKind::kLif && !config.is_dense() && !config.is_integer();
  const uint64_t coder_updates =
      has_coder_neurons ? counts.coder_gains * static_cast<uint64_t>(config.ticks) : 0;
  const uint64_t float_macs = counts.multiply_accumulates - counts.integer_multiply_accumulates +
                              coder_updates + counts.coder_gains + counts.gate_products;
  const double attention = config.is_dense() ? kFloatMultiplyAccumulate : kFloatAdd;
  return prices.accumulate * number(counts.accumulates) +
         prices.weight_multiply_accumulate * number(counts.integer_multiply_accumulates) +
         prices.population_update * number(counts.membrane_updates - coder_updates) +
         kFloatMultiplyAccumulate * number(float_macs) +
         attention * number(counts.attention_products) +
         kLayerNormElement * number(counts.layer_norm_elements) +
         kSoftmaxTerm * number(counts.softmax_terms);
}

// Returns the number of spikes whose neuron has a membrane. The generators of phase spikes and the
// draws of a Bernoulli coder have none.
double SpikesOfMembranes(const Counts& counts, const ModelConfig& config) {
  uint64_t spikes = counts.total_spikes() - counts.spikes(Stage::kPhase);
  if (config.coder == CoderKind::kBernoulli) {
    spikes -= counts.spikes(Stage::kCoder) + counts.spikes(Stage::kFfnIn) +
              counts.spikes(Stage::kReadout);
  }
  return static_cast<double>(spikes);
}

double Loihi(const Counts& counts, const ModelConfig& config) {
  const auto spikes = static_cast<double>(counts.total_spikes());
  const double active = SpikesOfMembranes(counts, config);
  return kLoihiSynapticOperation * static_cast<double>(counts.synaptic_operations()) +
         kLoihiActiveUpdate * active +
         kLoihiInactiveUpdate * (static_cast<double>(counts.membrane_updates) - active) +
         kLoihiSpike * spikes;
}

}  // namespace

const EnergyModelInfo& InfoOf(EnergyModel model) { return kInfos[static_cast<size_t>(model)]; }

bool Applies(EnergyModel model, const ModelConfig& config) {
  switch (model) {
    case EnergyModel::kHorowitz45nm:
      return true;
    case EnergyModel::kHorowitz45nmInt8:
    case EnergyModel::kLoihi2018:
      return config.arithmetic == Arithmetic::kInt8;
    case EnergyModel::kSpike5pj:
      break;
  }
  return !config.is_dense();
}

std::optional<double> EstimateEnergy(EnergyModel model, const Counts& counts,
                                     const ModelConfig& config) {
  if (!Applies(model, config)) return std::nullopt;
  switch (model) {
    case EnergyModel::kHorowitz45nm:
      return kPicojoule * Horowitz(counts, config, kFloat32);
    case EnergyModel::kHorowitz45nmInt8:
      return kPicojoule * Horowitz(counts, config, kInt8);
    case EnergyModel::kLoihi2018:
      return kPicojoule * Loihi(counts, config);
    case EnergyModel::kSpike5pj:
      break;
  }
  return kPicojoule * kPaperSpike * static_cast<double>(counts.total_spikes());
}

double DefaultEnergy(const Counts& counts, const ModelConfig& config) {
  return *EstimateEnergy(kDefaultEnergyModel, counts, config);
}

}  // namespace spikeserve
