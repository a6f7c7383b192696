// What the status page reads, as JSON. docs/watching.md describes it.
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
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// `{"time", "version", "serving", "policies", "metrics"}`: `time` in seconds of a clock that never
// goes back; `policies` as ListPolicies answers; `metrics` the families of /metrics by name, each a
// list of {"labels", "value"}, or {"labels", "count", "sum", "buckets"} with cumulative
// [upper bound, count] pairs, whose last bound, infinity, is null.
absl::StatusOr<std::string> StatusJson(const std::vector<prometheus::MetricFamily>& families,
                                       const v1::ListPoliciesResponse& policies, double time,
                                       bool serving);

// `{"open", "matching", "sessions"}`: of the open sessions that `caller` may see those that match
// `filter`, sorted, and of them `limit` from `offset` on, as SessionInfo. INVALID_ARGUMENT names
// the parameter that is wrong.
absl::StatusOr<std::string> SessionsJson(SessionStore& store, const Credential& caller,
                                         const HttpQuery& query);

// `{"code", "message"}`: the code's name.
std::string ErrorJson(const absl::Status& status);

}  // namespace spikeserve

#endif  // SERVER_WEB_STATUS_JSON_H_
