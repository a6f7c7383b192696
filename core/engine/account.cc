#include "core/engine/account.h"

#include <bit>
#include <cstdint>

#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

// Horowitz, ISSCC 2014, figure 1.1.9: 45 nm, 0.9 V.
constexpr double kAdd8 = 0.03;
constexpr double kAdd32 = 0.1;
constexpr double kMultiply8 = 0.2;
constexpr double kFloatMultiplyAccumulate = 3.7 + 0.9;
constexpr double kFloatAdd = 0.9;
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
// addition), gets its bias and is limited on both sides.
constexpr double kNormElement = kAdd32 + kAdd16 + kMultiply16 + 2 * kAdd32 + kShift16 +
                                2 * (kMultiply16 + kAdd32) + kAdd16 + 2 * kCompare16;
// Without a norm, an element of the residual stream is limited on both sides.
constexpr double kResidualLimit = 2 * kCompare16;
// The membrane gets the current and is compared with the threshold.
constexpr double kMembraneUpdate = kAdd16 + kCompare16;
// The leak is subtracted, with the bit that rounds it as the borrow, and the bias is added.
constexpr double kMembraneLeak = 2 * kAdd16;
// In int8 the membrane is also multiplied by the decay, and the product is rounded.
constexpr double kMultipliedMembraneUpdate = kMultiply16 + kAdd16 + kMembraneUpdate;
// Multiplied by the reciprocal of the sum of the weights, and rounded.
constexpr double kScaling = kMultiply16 + kAdd32;
// As in horowitz_45nm.
constexpr double kFloatSoftmaxTerm = 2 * kFloatMultiplyAccumulate;
constexpr double kFloatNormElement = 2 * kFloatAdd + 3.7 + 2 * kFloatMultiplyAccumulate;

double Number(uint64_t count) { return static_cast<double>(count); }

// Returns the comparisons that find a period from 1 to T, or none, in a sorted table.
double Comparisons(const ModelConfig& config) {
  return std::bit_width(static_cast<unsigned>(config.ticks));
}

bool IsInt8(const ModelConfig& config) { return config.arithmetic == Arithmetic::kInt8; }

// Returns the updates of the neurons of coders. They look their period up, so that nothing of this
// is computed, but int8 counts them as it always did.
uint64_t CoderUpdates(const Counts& counts, const ModelConfig& config) {
  const bool counted = IsInt8(config) && config.coder == CoderKind::kLif && !config.is_dense();
  return counted ? counts.coder_gains * static_cast<uint64_t>(config.ticks) : 0;
}

// Returns the spikes of coders that look periods up: each makes the tick of the next one.
uint64_t CoderSpikes(const Counts& counts, const ModelConfig& config) {
  if (config.coder != CoderKind::kLif) return 0;
  return counts.spikes(Stage::kCoder) + counts.spikes(Stage::kFfnIn) +
         counts.spikes(Stage::kReadout);
}

double CoderPrice(const ModelConfig& config) {
  if (!IsInt8(config)) return Comparisons(config) * kCompare16;
  // The current is a float32 number; a Bernoulli coder compares it with a draw at each tick.
  return kFloatMultiplyAccumulate +
         (config.coder == CoderKind::kLif ? Comparisons(config) : config.ticks) * kAdd32;
}

struct Price {
  double narrow;
  double wide;
};

// A product of attention: in integers an addition of a value that a power of two has shifted, or
// that its overlap has multiplied; in int8 a float32 addition; in a dense policy a
// multiply-accumulate.
Price AttentionPrice(const ModelConfig& config) {
  if (config.is_dense()) return {kMultiply8 + kAdd8, kMultiply8 + kAdd32};
  if (IsInt8(config)) return {kFloatAdd, kFloatAdd};
  if (config.attention == Attention::kLinear) {
    return {kMultiply16By8 + kAdd8, kMultiply16By8 + kAdd32};
  }
  return {kShift16 + kAdd16, kShift16 + kAdd32};
}

// Returns the elements of the residual stream that are limited without a norm. In integers each is
// coded once; the float32 numbers of int8 have no limits.
uint64_t LimitedElements(const Counts& counts, const ModelConfig& config) {
  return config.is_integer() && !config.has_norms() ? counts.coder_gains : 0;
}

uint64_t KeyBytes(const ModelConfig& config, int neurons) {
  return (static_cast<uint64_t>(config.ticks) * static_cast<uint64_t>(neurons) + 7) / 8;
}

// Returns the bytes of the weights of all layers. Those of the embeddings and the head are few.
double WeightMemory(const ModelConfig& config) {
  const double d = config.hidden_size;
  const double analog = IsInt8(config) ? sizeof(float) : 1;
  const double spiking = d * (3.0 * config.attention_inputs() + 2.0 * config.ffn_size);
  const double routing =
      config.has_routing() ? config.routing_hidden_size * (d + config.heads) : 0.0;
  return config.layers * (spiking + analog * (d * config.merged_size() + routing));
}

// Returns the bytes of a token's key and value in a layer.
double StoredBytes(const ModelConfig& config) {
  const auto d = static_cast<double>(config.hidden_size);
  if (config.is_dense()) return 2 * d;
  const auto bits = static_cast<double>(KeyBytes(config, config.hidden_size));
  return bits + (IsInt8(config) ? bits : d);
}

// Returns the bytes of keys and values that a spiking policy in int8 reads: at each tick the bits
// of a head.
double Int8AttentionBytes(const Counts& counts, const ModelConfig& config) {
  uint64_t terms = counts.softmax_terms;
  if (config.has_routing() && config.gate == Gate::kSoftmax) {
    terms -= counts.gate_products / static_cast<uint64_t>(config.head_size());
  }
  return Number(terms) * config.head_size() / 4.0;
}

}  // namespace

std::array<PricedOperation, kPricedOperations> OperationsOf(const Counts& counts,
                                                            const ModelConfig& config) {
  SPIKESERVE_DCHECK(config.arithmetic != Arithmetic::kFloat32);
  const bool int8 = IsInt8(config);
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
      same("membrane_update", counts.membrane_updates - CoderUpdates(counts, config),
           int8 ? kMultipliedMembraneUpdate : kMembraneUpdate),
      same("membrane_leak", counts.membrane_leaks, kMembraneLeak),
      same("coder_element", counts.coder_gains, CoderPrice(config)),
      same("coder_spike", CoderSpikes(counts, config), kAdd8),
      {"attention_product", Number(counts.attention_products), attention.narrow, attention.wide},
      same("attention_scaling", counts.attention_scalings, kScaling),
      same("softmax_term", counts.softmax_terms, int8 ? kFloatSoftmaxTerm : kSoftmaxTerm),
      {"gate_product", Number(counts.gate_products),
       int8 ? kFloatMultiplyAccumulate : kMultiply8 + kAdd8,
       int8 ? kFloatMultiplyAccumulate : kMultiply8 + kAdd32},
      same("norm_element", counts.layer_norm_elements, int8 ? kFloatNormElement : kNormElement),
      same("residual_limit", LimitedElements(counts, config), kResidualLimit),
  }};
}

std::array<PricedTraffic, kPricedTraffics> TrafficOf(const Counts& counts,
                                                     const ModelConfig& config) {
  SPIKESERVE_DCHECK(config.arithmetic != Arithmetic::kFloat32);
  const bool int8 = IsInt8(config);
  const double d = config.hidden_size;
  const auto priced = [](absl::string_view name, double bytes, double memory) {
    return PricedTraffic{name, bytes, memory, SramPrice(memory)};
  };
  const uint64_t integers = counts.integer_multiply_accumulates;
  const double weights = int8 ? Number(counts.accumulates + integers) +
                                    sizeof(float) * Number(counts.multiply_accumulates - integers)
                              : Number(counts.weight_bytes);
  // A membrane is read and written, its threshold and its bias are read: 16 bits each.
  const double neurons = 8 * Number(counts.membrane_updates - CoderUpdates(counts, config));
  // A coder reads the thresholds that it compares, in int8 its gain and its bias.
  const double coders = Number(counts.coder_gains) * (int8 ? 8 : 2 * Comparisons(config));
  return {{
      priced("weights", weights, WeightMemory(config)),
      priced("neurons", neurons, 6 * (3 * d + config.ffn_size)),
      priced("coders", coders, 2 * d * (int8 ? 8 : 2 * config.ticks)),
      priced("keys_and_values",
             int8 ? Int8AttentionBytes(counts, config) : Number(counts.attention_bytes),
             3 * config.context * StoredBytes(config)),
  }};
}

double SramPrice(double bytes) {
  constexpr double kKilobyte = 1024.0;
  if (bytes <= 8 * kKilobyte) return 10.0 / 8.0;
  return (bytes <= 32 * kKilobyte ? 20.0 : 100.0) / 8.0;
}

ModelConfig DenseTwin(const ModelConfig& config) {
  ModelConfig twin = config;
  twin.mode = Mode::kDense;
  twin.norm = NormKind::kLayer;
  twin.arithmetic = Arithmetic::kInteger;
  return twin;
}

Counts DenseTwinCounts(const ModelConfig& config, int inputs, int actions) {
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
