#include "core/engine/energy.h"

#include "core/engine/account.h"

namespace spikeserve {
namespace {

constexpr double kPicojoule = 1e-12;

// Horowitz, ISSCC 2014, figure 1.1.9: 45 nm, 0.9 V.
constexpr double kAdd = 0.9;
constexpr double kMultiply = 3.7;
constexpr double kMultiplyAccumulate = kMultiply + kAdd;

// A LayerNorm adds each element to the mean, subtracts the mean, squares and adds, multiplies by
// the inverse deviation, multiplies by a weight and adds a bias.
constexpr double kLayerNormElement = 2 * kAdd + kMultiply + 2 * kMultiplyAccumulate;
// A term of a softmax is scaled, subtracted from the best one, added to the sum and divided by it.
constexpr double kHorowitzSoftmaxTerm = 2 * kMultiplyAccumulate;

constexpr double kPaperSpike = 5.0;  // the paper, section 5.2

constexpr std::array<EnergyModelInfo, kEnergyModels> kInfos = {{
    {.counts =
         "int_45nm, and the bytes of weights, neurons, coders' tables, keys and values that are "
         "read or written: 1.25, 2.5 or 12.5 pJ a byte, by the smallest SRAM of 8 KB, 32 KB or "
         "1 MB that holds all weights, or that part of a layer; the weights of an input that "
         "fires are read once a token, those of activations once a decision",
     .leaves_out =
         "wires between memories, registers, control, activations between two maps, and what "
         "int_45nm leaves out except memory",
     .applies_to = "policies in integers, dense ones by the same rules",
     .source = "Horowitz, ISSCC 2014: 45 nm, 10, 20 and 100 pJ for 64 bits"},
    {.counts =
         "0.03 pJ an accumulate, 0.23 pJ a multiply-accumulate in 8 bits and 0.43 pJ one with "
         "a 16-bit activation; in integer 0.1 pJ a membrane update, 0.05 pJ each of the additions "
         "of a leak and of the comparisons that find a coder's period, 0.1 pJ an attention "
         "product, 0.9 pJ a "
         "scaling, 1.15 pJ a term of a softmax, 0.23 pJ a gate product, 3.05 pJ an element of a "
         "norm, 0.1 pJ a limit on both sides, of membranes, leaks and residuals; in dense policies "
         "0.23 pJ an attention product; 0.03 pJ a spike of a coder; the head in float32",
     .leaves_out = "memory and data movement, control, additions of residuals, roots, single "
                   "divisions, the phase generators, what rounds a sum of a map, the table of a "
                   "dense policy's activation and the scales of its vectors, the action head's "
                   "softmax or tanh",
     .applies_to = "policies in integers, dense ones by the same rules",
     .source =
         "Horowitz, ISSCC 2014: 45 nm, 0.9 V, integers of 8 and 32 bits; 16 bits interpolated"},
    {.counts = "0.9 pJ an accumulate, 4.6 pJ a multiply-accumulate, a membrane update, a coder "
               "gain and a gate product, 14.7 pJ an element of a LayerNorm, 9.2 pJ a term of a "
               "softmax; an attention product is an accumulate, in a dense policy a "
               "multiply-accumulate",
     .leaves_out = "memory and data movement, control, additions of biases and residuals, "
                   "exponentials, roots, divisions, the phase generators, the action head's "
                   "softmax or tanh",
     .applies_to = "every policy; one in integers is priced as if it were float32",
     .source = "Horowitz, ISSCC 2014: 45 nm, 0.9 V, float32"},
    {.counts = "5 pJ a spike",
     .leaves_out = "everything but spikes: synapses, membranes, attention, memory",
     .applies_to = "spiking policies",
     .source = "the paper, section 5.2"},
}};

double Horowitz(const Counts& counts, const ModelConfig& config) {
  const auto number = [](uint64_t count) { return static_cast<double>(count); };
  const double attention = config.is_dense() ? kMultiplyAccumulate : kAdd;
  return kAdd * number(counts.accumulates) +
         kMultiplyAccumulate * number(counts.multiply_accumulates + counts.membrane_updates +
                                      counts.coder_gains + counts.gate_products) +
         attention * number(counts.attention_products) +
         kLayerNormElement * number(counts.layer_norm_elements) +
         kHorowitzSoftmaxTerm * number(counts.softmax_terms);
}

double Operations(const Counts& counts, const ModelConfig& config) {
  double picojoules = 0.0;
  for (const PricedOperation& operation : OperationsOf(counts, config)) {
    picojoules += operation.count * operation.price;
  }
  return picojoules;
}

double Traffic(const Counts& counts, const ModelConfig& config) {
  double picojoules = 0.0;
  for (const PricedTraffic& traffic : TrafficOf(counts, config)) {
    picojoules += traffic.bytes * traffic.price;
  }
  return picojoules;
}

}  // namespace

const EnergyModelInfo& InfoOf(EnergyModel model) { return kInfos[static_cast<size_t>(model)]; }

bool Applies(EnergyModel model, const ModelConfig& config) {
  switch (model) {
    case EnergyModel::kHorowitz45nm:
      return true;
    case EnergyModel::kInt45nm:
    case EnergyModel::kIntSram45nm:
      return config.is_integer();
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
      return kPicojoule * Horowitz(counts, config);
    case EnergyModel::kInt45nm:
      return kPicojoule * Operations(counts, config);
    case EnergyModel::kIntSram45nm:
      return kPicojoule * (Operations(counts, config) + Traffic(counts, config));
    case EnergyModel::kSpike5pj:
      break;
  }
  return kPicojoule * kPaperSpike * static_cast<double>(counts.total_spikes());
}

double DefaultEnergy(const Counts& counts, const ModelConfig& config) {
  return *EstimateEnergy(kDefaultEnergyModel, counts, config);
}

}  // namespace spikeserve
