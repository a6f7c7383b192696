// Resource use of this process, under the metric names of the official Prometheus clients.
#pragma once

#include <vector>

#include "prometheus/metric_family.h"

namespace spikeserve {

// Returns process_cpu_seconds_total, process_resident_memory_bytes, process_open_fds,
// process_max_fds and process_start_time_seconds, read from /proc now, and
// spikeserve_allocated_bytes, which the allocator counts. Omits values that /proc does not provide.
// Thread-safe.
std::vector<prometheus::MetricFamily> CollectProcessMetrics();

}  // namespace spikeserve
