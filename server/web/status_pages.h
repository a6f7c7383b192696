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
#include "server/base/replicas.h"
#include "server/history/server_history.h"
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
    const ServerHistory* history;
    const Clock* clock;
    BackgroundWorker* worker;
    std::function<bool()> serving;
    std::string store_address;  // of the session store, without a password
    const Replicas* replicas;
  };

  explicit StatusPages(Parts parts);

  // Answers a request, on another thread: 401 without a valid token, 403 for a token of an agent,
  // 404 for an unknown path, 503 if too many requests of its client wait. /healthz needs no token,
  // waits for no other page, and answers 503 while the server does not serve.
  void Answer(const HttpRequest& request, const HttpServer::Done& done);

 private:
  void AnswerPage(const HttpRequest& request, const HttpServer::Done& done) const;
  HttpResponse Health() const;
  absl::StatusOr<std::string> Status(const HttpRequest& request) const;
  absl::StatusOr<std::string> History(const HttpRequest& request) const;
  absl::StatusOr<std::string> Session(const Credential& caller, const HttpRequest& request) const;
  absl::StatusOr<std::string> Sessions(const Credential& caller, const HttpRequest& request) const;
  // Calls `done` when the background worker has explained the decision.
  void Explain(const std::shared_ptr<const Credential>& caller, const HttpRequest& request,
               const HttpServer::Done& done) const;

  const Parts parts_;
  BackgroundWorker health_;
  BackgroundWorker pages_;  // clients take turns
};

}  // namespace spikeserve

#endif  // SERVER_WEB_STATUS_PAGES_H_
