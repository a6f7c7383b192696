// Exports how the traffic of every policy is divided.
//
// Pure functions; safe to call from many threads.
#ifndef SERVER_ROLLOUTS_TRAFFIC_METRICS_H_
#define SERVER_ROLLOUTS_TRAFFIC_METRICS_H_

#include <vector>

#include "prometheus/metric_family.h"
#include "server/policies/policy_catalog.h"

namespace spikeserve {

// Returns these gauges, read from `catalog`, so that they never name a version that is not served:
//   spikeserve_policy_traffic_ratio{policy,version}: share of the new sessions that name neither a
//     version nor a label
//   spikeserve_policy_label_info{policy,version,label}: 1
//   spikeserve_policy_shadow_info{policy,version}: 1 for the shadow
//   spikeserve_policy_rollout_ratio{policy,version,state}: share that the last roll-out has reached
//   spikeserve_policy_rollout_disputed{policy,version}: 1 while a roll-out waits because
//     one tenant's sessions decide, otherwise 0
//   spikeserve_policy_rollout_ended_timestamp_seconds{policy,version,state}: Unix time
std::vector<prometheus::MetricFamily> CollectTraffic(const PolicyCatalog& catalog);

}  // namespace spikeserve

#endif  // SERVER_ROLLOUTS_TRAFFIC_METRICS_H_
