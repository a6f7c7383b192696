#include "core/engine/account.h"

#include <bit>
#include <cstdint>

#include "core/contract/dcheck.h"
#include "core/engine/token_costs.h"

namespace spikeserve {
namespace {

// Horowitz, ISSCC 2014, figure 1.1.9: 45 nm, 0.9 V.
constexpr double kAdd8 = 0.03;
constexpr double kAdd32 = 0.1;
constexpr double kMultiply8 = 0.2;
constexpr double kFloatMultiplyAccumulate = 3.7 + 0.9;
// Interpolated: an addition costs in proportion to its bits, a multiplication to the product of the
// bits of its factors. By this rule one of 32 bits would cost 3.2; the table has 3.1.
constexpr double kAdd16 = 0.05;
constexpr double kMultiply16By8 = 0.4;
constexpr double kMultiply16 = 0.8;
// A comparison is a subtraction; a shift by a variable number of bits costs no more.
constexpr double kCompare16 = kAdd16;
constexpr double kShift16 = kAdd16;

// A term is compared with the best one, subtracted from it, scaled to octaves, rounded, turned into
// a power of two by a shift, and added to the sum.
constexpr double kSoftmaxTerm = kCompare16 + kAdd16 + kMultiply16 + kAdd32 + kShift16 + kAdd32;
// An element is added to the sum, loses the mean, is squared and added to a sum of 64 bits,
// shifted, multiplied by the inverse root and by its weight (each product is rounded by an
// addition), and gets its bias.
constexpr double kNormElement =
    kAdd32 + kAdd16 + kMultiply16 + 2 * kAdd32 + kShift16 + 2 * (kMultiply16 + kAdd32) + kAdd16;
// A sum that may saturate is compared with both bounds.
constexpr double kLimit = 2 * kCompare16;
// The membrane gets the current and is compared with the threshold.
constexpr double kMembraneUpdate = kAdd16 + kCompare16;
// The leak is the sum of its signed binary digits, shifted; they are subtracted, with the bit that
// rounds them as the borrow, and the bias is added.
double MembraneLeak(const ModelConfig& config) {
  const auto leak = static_cast<unsigned>(config.leak());
  return (std::popcount(leak ^ (3 * leak)) + 1) * kAdd16;
}
// Multiplied by the reciprocal of the sum of the weights, and rounded.
constexpr double kScaling = kMultiply16 + kAdd32;

double Number(uint64_t count) { return static_cast<double>(count); }

// Returns the comparisons that find a period from 1 to T, or none, in a sorted table.
double Comparisons(const ModelConfig& config) {
  return std::bit_width(static_cast<unsigned>(config.ticks));
}

// Returns the spikes of coders: each makes the tick of the next one.
uint64_t CoderSpikes(const Counts& counts) {
  return counts.spikes(Stage::kCoder) + counts.spikes(Stage::kFfnIn) +
         counts.spikes(Stage::kReadout);
}

struct Price {
  double narrow;
  double wide;
};

// A product of attention: an addition of a value that a power of two has shifted, in a dense policy
// a multiply-accumulate.
Price AttentionPrice(const ModelConfig& config) {
  if (config.is_dense()) return {kMultiply8 + kAdd8, kMultiply8 + kAdd32};
  return {kShift16 + kAdd16, kShift16 + kAdd32};
}

// Returns the sums that are limited on both sides: those of a membrane, of its leak, and the
// elements of the residual stream, before a norm and behind it. Without norms, each element is
// limited once and coded once.
uint64_t Limits(const Counts& counts, const ModelConfig& config) {
  const uint64_t residuals =
      config.has_norms() ? 2 * counts.layer_norm_elements : counts.coder_gains;
  return counts.membrane_updates + counts.membrane_leaks + residuals;
}

// Returns the bytes of the weights of all layers. Those of the embeddings and the head are few.
double WeightMemory(const ModelConfig& config) {
  const double d = config.hidden_size;
  const double spiking = d * (3.0 * config.attention_inputs() + 2.0 * config.ffn_size);
  const double routing =
      config.has_routing() ? config.routing_hidden_size * (d + config.heads) : 0.0;
  return config.layers * (spiking + d * config.merged_size() + routing);
}

// Returns the bytes of a token's key and value in a layer.
double StoredBytes(const ModelConfig& config) {
  if (config.is_dense()) return 2.0 * config.hidden_size;
  return Number(SpikeBytes(config.ticks, config.hidden_size) +
                ValueBytes(config, config.ticks, config.hidden_size));
}

}  // namespace

std::array<PricedOperation, kPricedOperations> OperationsOf(const Counts& counts,
                                                            const ModelConfig& config) {
  SPIKESERVE_DCHECK(config.is_integer());
  const uint64_t integers = counts.integer_multiply_accumulates;
  const Price attention = AttentionPrice(config);
  const auto same = [](absl::string_view name, uint64_t count, double price) {
    return PricedOperation{name, Number(count), price, price};
  };
  return {{
      {"accumulate", Number(counts.accumulates), kAdd8, kAdd16},
      {"multiply_accumulate", Number(integers - counts.wide_multiply_accumulates),
       kMultiply8 + kAdd8, kMultiply8 + kAdd32},
      {"wide_multiply_accumulate", Number(counts.wide_multiply_accumulates), kMultiply16By8 + kAdd8,
       kMultiply16By8 + kAdd32},
      same("float_multiply_accumulate", counts.multiply_accumulates - integers,
           kFloatMultiplyAccumulate),
      same("membrane_update", counts.membrane_updates, kMembraneUpdate),
      same("membrane_leak", counts.membrane_leaks, MembraneLeak(config)),
      same("coder_element", counts.coder_gains, Comparisons(config) * kCompare16),
      same("coder_spike", CoderSpikes(counts), kAdd8),
      {"attention_product", Number(counts.attention_products), attention.narrow, attention.wide},
      same("attention_scaling", counts.attention_scalings, kScaling),
      same("softmax_term", counts.softmax_terms, kSoftmaxTerm),
      {"gate_product", Number(counts.gate_products), kMultiply8 + kAdd8, kMultiply8 + kAdd32},
      same("norm_element", counts.layer_norm_elements, kNormElement),
      same("limit", Limits(counts, config), kLimit),
  }};
}

std::array<PricedTraffic, kPricedTraffics> TrafficOf(const Counts& counts,
                                                     const ModelConfig& config) {
  SPIKESERVE_DCHECK(config.is_integer());
  const double d = config.hidden_size;
  const auto priced = [](absl::string_view name, double bytes, double memory) {
    return PricedTraffic{name, bytes, memory, SramPrice(memory)};
  };
  // A threshold and a bias of 16 bits. The membrane begins at 0, and stays in a register for all
  // ticks of a token.
  const double neurons = 4 * Number(counts.driven_neurons);
  // A coder reads the thresholds that it compares.
  const double coders = Number(counts.coder_gains) * 2 * Comparisons(config);
  return {{
      priced("weights", Number(counts.weight_bytes), WeightMemory(config)),
      priced("neurons", neurons, 4 * (3 * d + config.ffn_size)),
      priced("coders", coders, 4 * d * config.ticks),
      priced("keys_and_values", Number(counts.attention_bytes),
             3 * config.context * StoredBytes(config)),
  }};
}

double SramPrice(double bytes) {
  constexpr double kKilobyte = 1024.0;
  if (bytes <= 8 * kKilobyte) return 10.0 / 8.0;
  return (bytes <= 32 * kKilobyte ? 20.0 : 100.0) / 8.0;
}

ModelConfig DenseBaseline(const ModelConfig& config) {
  ModelConfig dense = config;
  dense.mode = Mode::kDense;
  dense.norm = NormKind::kLayer;
  dense.arithmetic = Arithmetic::kInteger;
  return dense;
}

Counts DenseBaselineCounts(const ModelConfig& config, int inputs, int actions) {
  const auto size = [](int value) { return static_cast<uint64_t>(value); };
  const uint64_t d = size(config.hidden_size);
  const uint64_t layers = size(config.layers);
  const uint64_t timesteps = size(config.context);
  // The tokens that the action, the return and the state of a decision attend to. The action
  // belongs to the timestep before, whose window is full.
  const uint64_t keys[] = {3 * timesteps, 3 * timesteps - 2, 3 * timesteps - 1};
  const uint64_t outputs = 3 * (layers - 1) + 1;
  const uint64_t rows = (layers - 1) * (keys[0] + keys[1] + keys[2]) + keys[2];
  const uint64_t output_weights = d * (2 * d + 2 * size(config.ffn_size));
  const uint64_t embeddings = d * (1 + size(inputs) + size(actions));
  Counts counts;
  counts.wide_multiply_accumulates = embeddings;
  counts.integer_multiply_accumulates =
      embeddings + 3 * layers * 2 * d * d + outputs * output_weights;
  counts.multiply_accumulates = counts.integer_multiply_accumulates + d * size(actions);
  counts.attention_products = 2 * d * rows;
  counts.attention_scalings = d * outputs;
  counts.softmax_terms = size(config.heads) * rows;
  counts.layer_norm_elements = d * (3 + 2 * outputs);
  counts.weight_bytes =
      embeddings + layers * (2 * d * d + output_weights) + d * size(actions) * sizeof(float);
  counts.attention_bytes = 2 * d * (3 * layers + rows);
  return counts;
}

}  // namespace spikeserve
