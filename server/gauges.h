// The metrics that are read from the parts of the server whenever somebody asks for them.
//
// Free functions, safe to call from many threads.
#pragma once

#include <vector>

#include "core/open_sessions/session_store.h"
#include "prometheus/metric_family.h"
#include "server/access/certificate_watch.h"
#include "server/agent/datagram_channels.h"
#include "server/heads/head_log_store.h"
#include "server/policies/policy_catalog.h"
#include "server/transport/transport.h"

namespace spikeserve {

// Returns spikeserve_robots and spikeserve_silent_robots. Takes no lock of a session. Thread-safe.
std::vector<prometheus::MetricFamily> CollectRobots(SessionStore& store);

// Returns spikeserve_seats. Takes the locks of the sessions that operators have taken. Thread-safe.
std::vector<prometheus::MetricFamily> CollectSeats(SessionStore& store);

// Returns, read from `certificates`:
//   spikeserve_tls_reload_failing: 1 while changed files of TLS cannot be used
//   spikeserve_tls_expiry_timestamp_seconds{certificate}: Unix time; of the server's certificate
//     with its chain, and of the authorities of clients, if TLS uses them
std::vector<prometheus::MetricFamily> CollectCertificates(const CertificateWatch& certificates);

// Returns these gauges, whose labels are policy and version:
//   spikeserve_head_held_out_sessions: open sessions of this server that contribute nothing to
//     their shared head, because they judge it
//   spikeserve_head_trimmed_contributions: contributions that the shared heads have shortened
std::vector<prometheus::MetricFamily> CollectHeads(const PolicyCatalog& catalog);

// Returns spikeserve_head_log_position{policy,version}, read from `logs`.
std::vector<prometheus::MetricFamily> CollectHeadLogs(HeadLogStore& logs);

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

// Returns, read from `datagrams`:
//   spikeserve_datagrams_total{outcome}: what has arrived on --datagram_listen
std::vector<prometheus::MetricFamily> CollectDatagrams(const DatagramChannels& datagrams);

// Returns, read from `transport`:
//   spikeserve_connections{state}: open ones, by state: known or unauthenticated
//   spikeserve_connections_limit
//   spikeserve_connections_refused_total{limit}: new ones that met a limit
//   spikeserve_connections_dropped_total{limit}: unauthenticated ones that made room for others
//   spikeserve_bytes_in_flight{of}: what calls of all callers, and connections and calls of
//     unauthenticated clients, occupy
std::vector<prometheus::MetricFamily> CollectConnections(const Transport& transport);

}  // namespace spikeserve
