// Prices every operation and every byte of a decision in integers, beside those of a dense policy
// of the same sizes (core/engine/account.h).
//
// All functions are pure and thread-safe.
#pragma once

#include <array>
#include <cstdint>
#include <string>

#include "absl/status/statusor.h"
#include "core/engine/account.h"
#include "core/model/policy.h"
#include "nlohmann/json.hpp"
#include "train/evaluation/evaluation.h"

namespace spikeserve {

// What one decision costs. Counts and bytes are means.
struct DecisionCost {
  std::array<PricedOperation, kPricedOperations> operations;
  std::array<PricedTraffic, kPricedTraffics> traffic;

  // In nanojoules: by int_45nm, the same with adders as wide as the accumulators, and what memory
  // adds in int_sram_45nm.
  double operations_energy() const;
  double wide_operations_energy() const;
  double traffic_energy() const;
};

struct EnergyAccount {
  std::string environment;
  uint64_t decisions = 0;
  DecisionCost policy;
  // A dense policy in integers. If it was not played, it has the sizes of the policy, a full
  // window, three new tokens and no zero among its activations.
  DecisionCost dense;
  bool dense_was_played = false;
};

// Returns the account of what was evaluated. INVALID_ARGUMENT for a policy in float32.
absl::StatusOr<EnergyAccount> AccountOf(const Policy& policy, const Evaluation& evaluation);

// Replaces the dense policy by one that was evaluated. INVALID_ARGUMENT for a spiking policy or one
// in float32.
absl::Status SetDense(const Policy& dense, const Evaluation& evaluation, EnergyAccount* account);

nlohmann::ordered_json ToJson(const EnergyAccount& account);

// Formats the account as tables for the terminal.
std::string ToText(const EnergyAccount& account);

}  // namespace spikeserve
