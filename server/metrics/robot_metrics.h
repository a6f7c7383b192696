// Metrics of the robots that declared their period, read from the open sessions.
#ifndef SERVER_METRICS_ROBOT_METRICS_H_
#define SERVER_METRICS_ROBOT_METRICS_H_

#include <vector>

#include "core/open_sessions/session_store.h"
#include "prometheus/metric_family.h"

namespace spikeserve {

// Returns spikeserve_robots and spikeserve_silent_robots. Takes no lock of a session. Thread-safe.
std::vector<prometheus::MetricFamily> CollectRobots(SessionStore& store);

}  // namespace spikeserve

#endif  // SERVER_METRICS_ROBOT_METRICS_H_
