// Answers HTTP requests: /metrics, /healthz, and the status page with the JSON that it reads.
#ifndef SERVER_WEB_STATUS_PAGES_H_
#define SERVER_WEB_STATUS_PAGES_H_

#include <functional>
#include <string>
#include <utility>

#include "absl/status/statusor.h"
#include "core/base/clock.h"
#include "core/session/session_store.h"
#include "server/access/authenticator.h"
#include "server/admin/rollout_handler.h"
#include "server/agent/policy_handler.h"
#include "server/base/background_worker.h"
#include "server/metrics/metrics.h"
#include "server/web/http_server.h"

namespace spikeserve {

// Thread-safe.
class StatusPages {
 public:
  // The objects whose state the pages show. All must outlive the pages.
  struct Parts {
    const Authenticator* authenticator;
    const PolicyHandler* handler;
    const RolloutHandler* rollouts;
    SessionStore* store;
    const Metrics* metrics;
    const Clock* clock;
    BackgroundWorker* worker;
    std::function<bool()> serving;
  };

  explicit StatusPages(Parts parts) : parts_(std::move(parts)) {}

  // Answers a request: 401 without a valid token, 403 for a token of an agent, 404 for an unknown
  // path. /healthz needs no token and answers 503 while the server does not serve.
  HttpResponse Answer(const HttpRequest& request) const;

 private:
  HttpResponse Health() const;
  absl::StatusOr<std::string> Status() const;
  absl::StatusOr<std::string> Sessions(const Credential& caller, const HttpRequest& request) const;
  // Blocks until the background worker has explained the decision.
  absl::StatusOr<std::string> Explain(const Credential& caller, const HttpRequest& request) const;

  const Parts parts_;
};

}  // namespace spikeserve

#endif  // SERVER_WEB_STATUS_PAGES_H_
