// Measures a spiking policy in the terms of NeuroBench (Yik et al., Nature Communications 2025): a
// sample is a decision.
//
// All functions are pure and thread-safe.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/dataset/dataset.h"
#include "core/engine/counts.h"
#include "core/model/policy.h"
#include "nlohmann/json.hpp"
#include "train/evaluation/evaluation.h"

namespace spikeserve {

// The numbers of operations are means over the decisions.
struct NeuroBench {
  uint64_t decisions = 0;
  uint64_t footprint_bytes = 0;      // all parameters and buffers of the policy file
  double connection_sparsity = 0.0;  // share of the weights of all maps that are zero
  double activation_sparsity = 0.0;  // 1 - spikes / (neurons x ticks), coder neurons included
  double effective_acs = 0.0;        // nonzero weight x spike
  double effective_macs = 0.0;       // nonzero weight x nonzero analog input
  double dense = 0.0;                // all products of the same maps, zeros included
  double attention_products = 0.0;   // outside NeuroBench's hooks, so listed beside
  double membrane_updates = 0.0;
};

// Measures a policy by the counts of an evaluation. INVALID_ARGUMENT for a policy of mode dense.
absl::StatusOr<NeuroBench> MeasureNeuroBench(const Policy& policy, const Evaluation& evaluation);

// Returns INVALID_ARGUMENT unless a server recorded the episode, and it fits the policy.
absl::Status CheckServedEpisode(const Policy& policy, const Dataset& dataset,
                                const Episode& episode);

// Decides what was decided in recorded episodes again: conditions each decision on the recorded
// observation and return-to-go, and continues with the recorded action. INVALID_ARGUMENT if an
// episode was not recorded by a server, or does not fit the policy.
absl::StatusOr<Evaluation> DecideAgain(std::shared_ptr<const Policy> policy,
                                       const std::vector<Dataset>& recordings);

// Converts the metrics to JSON, under NeuroBench's names.
nlohmann::ordered_json ToJson(const NeuroBench& metrics);

// Formats the metrics as text for the terminal.
std::string ToText(const NeuroBench& metrics);

}  // namespace spikeserve
