// What a server shows over HTTP: /metrics, /healthz, and the status page with the JSON it reads.
#ifndef SERVER_WEB_STATUS_PAGES_H_
#define SERVER_WEB_STATUS_PAGES_H_

#include <functional>
#include <string>
#include <utility>

#include "absl/status/statusor.h"
#include "core/base/clock.h"
#include "core/session/session_store.h"
#include "server/access/authenticator.h"
#include "server/agent/policy_handler.h"
#include "server/base/background_worker.h"
#include "server/metrics/metrics.h"
#include "server/web/http_server.h"

namespace spikeserve {

// Thread-safe.
class StatusPages {
 public:
  // What is shown; all must outlive the pages.
  struct Parts {
    const Authenticator* authenticator;
    const PolicyHandler* handler;
    SessionStore* store;
    const Metrics* metrics;
    const Clock* clock;
    BackgroundWorker* worker;
    std::function<bool()> serving;
  };

  explicit StatusPages(Parts parts) : parts_(std::move(parts)) {}

  // The one entry: every request over HTTP comes through here. 401 without a good token, 403 with
  // an agent's, 404 where there is no such page. /healthz is everybody's, and 503 unless the server
  // serves.
  HttpResponse Answer(const HttpRequest& request) const;

 private:
  HttpResponse Health() const;
  absl::StatusOr<std::string> Status() const;
  absl::StatusOr<std::string> Sessions(const Credential& caller, const HttpRequest& request) const;
  // Waits for the background worker.
  absl::StatusOr<std::string> Explain(const Credential& caller, const HttpRequest& request) const;

  const Parts parts_;
};

}  // namespace spikeserve

#endif  // SERVER_WEB_STATUS_PAGES_H_
