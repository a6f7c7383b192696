// The pages an operator looks at: /metrics, /healthz and an index.
#ifndef SERVER_STATUS_PAGES_H_
#define SERVER_STATUS_PAGES_H_

#include "absl/strings/string_view.h"
#include "server/http_server.h"
#include "server/metrics.h"

namespace spikeserve {

// The page at `path`; 404 where there is none. /healthz is 503 unless `serving`. Safe to call from
// many threads.
HttpResponse StatusPage(absl::string_view path, const Metrics& metrics, bool serving);

}  // namespace spikeserve

#endif  // SERVER_STATUS_PAGES_H_
