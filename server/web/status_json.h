// Writes the state of the server as JSON. server/web/static/schema.json describes the format.
//
// Free functions, safe to call from many threads.
#pragma once

#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "nlohmann/json.hpp"
#include "prometheus/metric_family.h"
#include "server/base/replica_reports.h"
#include "spikeserve/v1/policy_admin.pb.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// What StatusJson() tells of the server itself.
struct ServerStatus {
  double time = 0.0;  // in seconds of a monotonic clock
  bool serving = false;
  std::string store = "";                   // address of the session store, without a password
  std::string replica = "";                 // what the store calls this server; empty for memory
  int replicas = 1;                         // servers that share the store and are alive
  std::vector<ReplicaReport> reports = {};  // of these servers; see ServerReport
};

// Returns `figures`, which ServerHistory::Status returns, with "time", "version", "serving",
// "store", "replica", "replicas", "servers", "policies", "rollouts" and "metrics". "policies" is
// the list of ListPolicies, "rollouts" that of ListRollouts. "metrics" maps the name of each metric
// family to a list of {"labels", "value"}, or of {"labels", "count", "sum", "buckets"}, where
// "buckets" holds cumulative [upper bound, count] pairs and the last bound, infinity, is null.
std::string StatusJson(nlohmann::json figures,
                       const std::vector<prometheus::MetricFamily>& families,
                       const v1::ListPoliciesResponse& policies,
                       const v1::ListRolloutsResponse& rollouts, const ServerStatus& server);

// Returns what this server reports to the others: `summary`, which ServerHistory::Summary returns,
// with "address" of the status page, "version" and "serving".
std::string ServerReport(nlohmann::json summary, const std::string& address, bool serving);

// Returns {"code", "message"} of an error; "code" is the name of the status code.
std::string ErrorJson(const absl::Status& status);

}  // namespace spikeserve
