// What this process takes from its machine, under the names that Prometheus's own clients use.
#ifndef SERVER_METRICS_PROCESS_METRICS_H_
#define SERVER_METRICS_PROCESS_METRICS_H_

#include <vector>

#include "prometheus/metric_family.h"

namespace spikeserve {

// process_cpu_seconds_total, process_resident_memory_bytes, process_open_fds, process_max_fds and
// process_start_time_seconds, as Linux's /proc has them now; what /proc does not say is left out.
// Thread-safe.
std::vector<prometheus::MetricFamily> CollectProcessMetrics();

}  // namespace spikeserve

#endif  // SERVER_METRICS_PROCESS_METRICS_H_
