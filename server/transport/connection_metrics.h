// Exports how many connections there are, and which limits refused or closed others.
//
// Thread-safe.
#ifndef SERVER_TRANSPORT_CONNECTION_METRICS_H_
#define SERVER_TRANSPORT_CONNECTION_METRICS_H_

#include <vector>

#include "prometheus/metric_family.h"
#include "server/transport/transport.h"

namespace spikeserve {

// Returns, read from `transport`:
//   spikeserve_connections{state}: open ones, by state: known or unauthenticated
//   spikeserve_connections_limit
//   spikeserve_connections_refused_total{limit}: new ones that met a limit
//   spikeserve_connections_dropped_total{limit}: unauthenticated ones that made room for others
//   spikeserve_bytes_in_flight{of}: what calls of all callers, and connections and calls of
//     unauthenticated clients, occupy
std::vector<prometheus::MetricFamily> CollectConnections(const Transport& transport);

}  // namespace spikeserve

#endif  // SERVER_TRANSPORT_CONNECTION_METRICS_H_
