// How `spikectl explain` shows a decision at a terminal.
#ifndef CLIENT_SPIKECTL_EXPLAIN_REPORT_H_
#define CLIENT_SPIKECTL_EXPLAIN_REPORT_H_

#include <string>

#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// What went in and came out, then a raster of each population that fired (a cell for each neuron
// that did, a column for each tick), the routing gates of the state token, and the keys to which
// each head attends most.
std::string ExplainToText(const v1::ExplainResponse& explained);

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_EXPLAIN_REPORT_H_
