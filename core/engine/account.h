// Lists what a decision in integers does, operation by operation and byte by byte, with the price
// of each: the account behind the energy models int_45nm and int_sram_45nm (energy.h).
//
// Policies in integer arithmetic have an account, spiking and dense ones by the same rules.
// docs/reference/energy.md derives every price. All functions are pure and thread-safe, and
// allocate no memory. Example:
//
//   for (const PricedOperation& operation : OperationsOf(counts, config)) {
//     picojoules += operation.count * operation.price;
//   }
#pragma once

#include <array>

#include "absl/strings/string_view.h"
#include "core/engine/counts.h"
#include "core/model/config.h"

namespace spikeserve {

// Prices in picojoules.
struct PricedOperation {
  absl::string_view name;
  double count = 0.0;
  double price = 0.0;       // of one, with sums in adders of 8 bits
  double wide_price = 0.0;  // of one, with sums in adders as wide as the accumulator
};

// Bytes that are read from or written to one kind of memory.
struct PricedTraffic {
  absl::string_view name;
  double bytes = 0.0;
  double memory = 0.0;  // bytes that one memory of this kind holds
  double price = 0.0;   // picojoules a byte, by the size of the memory
};

inline constexpr int kPricedOperations = 14;
inline constexpr int kPricedTraffics = 4;

// Return the account of `counts`. REQUIRES: the policy is in integer arithmetic.
std::array<PricedOperation, kPricedOperations> OperationsOf(const Counts& counts,
                                                            const ModelConfig& config);
std::array<PricedTraffic, kPricedTraffics> TrafficOf(const Counts& counts,
                                                     const ModelConfig& config);

// Returns the energy of a byte of an SRAM of `bytes` bytes, in picojoules: Horowitz (ISSCC 2014)
// has 10, 20 and 100 pJ for 64 bits of 8 KB, 32 KB and 1 MB. A smaller memory costs as much as the
// next larger one of these, and one of more than 1 MB as much as one of 1 MB.
double SramPrice(double bytes);

// Returns the configuration of the dense policy in integer arithmetic that has the sizes of
// `config`.
ModelConfig DenseBaseline(const ModelConfig& config);

// Returns what a decision of DenseBaseline(config) costs with three new tokens and a full window,
// if no activation and no weight is zero. `inputs` is the number of inputs of the state embedding,
// `actions` that of outputs of the head.
Counts DenseBaselineCounts(const ModelConfig& config, int inputs, int actions);

}  // namespace spikeserve
