// Writes the JSON that the status page reads. docs/watching.md describes the format.
//
// Free functions, safe to call from many threads.
#ifndef SERVER_WEB_STATUS_JSON_H_
#define SERVER_WEB_STATUS_JSON_H_

#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/session/session_store.h"
#include "prometheus/metric_family.h"
#include "server/access/authenticator.h"
#include "server/base/http_query.h"
#include "spikeserve/v1/policy_admin.pb.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// What StatusJson() tells of the server itself.
struct ServerStatus {
  double time = 0.0;  // in seconds of a monotonic clock
  bool serving = false;
  std::string store = "";    // address of the session store, without a password
  std::string replica = "";  // what the store calls this server; empty for memory
  int replicas = 1;          // servers that share the store and are alive
};

// Returns {"time", "version", "serving", "store", "replica", "replicas", "policies", "rollouts",
// "metrics"}. "policies" is the list of ListPolicies, "rollouts" that of ListRollouts.
// "metrics" maps the name of each metric family to a list of {"labels", "value"}, or of {"labels",
// "count", "sum", "buckets"}, where "buckets" holds cumulative [upper bound, count] pairs and the
// last bound, infinity, is null.
absl::StatusOr<std::string> StatusJson(const std::vector<prometheus::MetricFamily>& families,
                                       const v1::ListPoliciesResponse& policies,
                                       const v1::ListRolloutsResponse& rollouts,
                                       const ServerStatus& server);

// Returns {"open", "matching", "sessions"}. "open" is the number of sessions that `caller` may
// read, "matching" the number of those that match the parameter `filter`. "sessions" holds a page
// of the matching ones as SessionInfo, sorted by `sort` and `order`: at most `limit`, starting at
// `offset`. Returns INVALID_ARGUMENT, which names the parameter, if a parameter is not valid.
absl::StatusOr<std::string> SessionsJson(SessionStore& store, const Credential& caller,
                                         const HttpQuery& query);

// Returns {"code", "message"} of an error; "code" is the name of the status code.
std::string ErrorJson(const absl::Status& status);

}  // namespace spikeserve

#endif  // SERVER_WEB_STATUS_JSON_H_
