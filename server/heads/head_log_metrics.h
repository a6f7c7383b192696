// Counts what a server does with the logs of shared heads:
//   spikeserve_head_log_entries_total{outcome}: appended, known or folded
//   spikeserve_head_log_reloads_total{outcome}: reloaded, rewritten or cut
//   spikeserve_head_log_position{policy, version}
//
// Thread-safe.
#ifndef SERVER_HEADS_HEAD_LOG_METRICS_H_
#define SERVER_HEADS_HEAD_LOG_METRICS_H_

#include "prometheus/counter.h"
#include "prometheus/family.h"
#include "prometheus/gauge.h"
#include "prometheus/registry.h"

namespace spikeserve {

struct HeadLogMetrics {
  // `registry` must outlive the metrics.
  explicit HeadLogMetrics(prometheus::Registry* registry);

  prometheus::Counter& appended;
  prometheus::Counter& known;
  prometheus::Counter& folded;
  prometheus::Counter& reloaded;
  prometheus::Counter& rewritten;
  prometheus::Counter& cut;
  prometheus::Family<prometheus::Gauge>& positions;
};

}  // namespace spikeserve

#endif  // SERVER_HEADS_HEAD_LOG_METRICS_H_
