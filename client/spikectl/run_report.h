// Formats the episodes of `spikectl run` as a table or as one JSON object.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "client/spikectl/agent.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// Returns the header of the table.
std::string RunTableHead();

// Returns the line of the episode that started from `seed`.
std::string RunTableLine(uint64_t seed, const EpisodeRecord& episode);

// Returns the summary below the table. It names its energy model, the first that applies
// to the policy; the lines of the table use the same. REQUIRES: at least one episode.
std::string RunSummary(const std::vector<EpisodeRecord>& episodes);

// Returns an object with `episodes`, `mean_return`, `spikes_per_decision`,
// `energy_joules_per_decision` by the same model, `energy_model`, `energy_models` (by name),
// `p50_seconds` and `p99_seconds`. REQUIRES: at least one episode.
nlohmann::ordered_json RunToJson(const std::vector<EpisodeRecord>& episodes);

}  // namespace spikeserve
