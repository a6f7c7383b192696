// How `spikectl run` shows its episodes: a table as they are played, or one JSON object.
#ifndef CLIENT_SPIKECTL_RUN_REPORT_H_
#define CLIENT_SPIKECTL_RUN_REPORT_H_

#include <cstdint>
#include <string>
#include <vector>

#include "client/spikectl/agent.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// The head of the table. `energy_model` names the model behind EpisodeRecord::energy_joules.
std::string RunTableHead(const std::string& energy_model);

// The line of the episode that started from `seed`.
std::string RunTableLine(uint64_t seed, const EpisodeRecord& episode);

// The lines below the table. REQUIRES: at least one episode.
std::string RunSummary(const std::vector<EpisodeRecord>& episodes, const std::string& energy_model);

// `episodes`, `mean_return`, `spikes_per_decision`, `energy_joules_per_decision`, `p50_seconds`,
// `p99_seconds`. REQUIRES: at least one episode.
nlohmann::ordered_json RunToJson(const std::vector<EpisodeRecord>& episodes);

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_RUN_REPORT_H_
