// Tells in metrics how the shared heads are protected.
//
// A free function, safe to call from many threads.
#ifndef SERVER_ADMIN_HEAD_METRICS_H_
#define SERVER_ADMIN_HEAD_METRICS_H_

#include <vector>

#include "prometheus/metric_family.h"
#include "server/policies/policy_catalog.h"

namespace spikeserve {

// Returns these gauges, whose labels are policy and version:
//   spikeserve_head_held_out_sessions: open sessions of this server that contribute nothing to
//     their shared head, because they judge it
//   spikeserve_head_trimmed_contributions: contributions that the shared heads have shortened
std::vector<prometheus::MetricFamily> CollectHeads(const PolicyCatalog& catalog);

}  // namespace spikeserve

#endif  // SERVER_ADMIN_HEAD_METRICS_H_
