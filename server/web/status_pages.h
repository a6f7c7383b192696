// Answers HTTP requests: /metrics, /healthz, and the status page with the JSON that it reads.
#pragma once

#include <functional>
#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "core/open_sessions/session_store.h"
#include "server/access/authenticator.h"
#include "server/admin/admin_handler.h"
#include "server/agent/policy_handler.h"
#include "server/base/background_worker.h"
#include "server/base/live_servers.h"
#include "server/base/replica_reports.h"
#include "server/history/server_history.h"
#include "server/metrics/metrics.h"
#include "server/web/http_server.h"
#include "server/web/session_feed.h"
#include "server/web/shared_answers.h"

namespace spikeserve {

// Thread-safe.
class StatusPages {
 public:
  // The objects whose state the pages show. All must outlive the pages.
  struct Parts {
    const Authenticator* authenticator;
    const PolicyHandler* handler;
    const AdminHandler* admin;
    SessionStore* store;
    const Metrics* metrics;
    const ServerHistory* history;
    const Clock* clock;
    BackgroundWorker* worker;
    std::function<bool()> serving;
    std::string store_address;  // of the session store, without a password
    const LiveServers* replicas;
    const ReplicaReports* reports;  // of these replicas
    double unusual_deviations;      // of the metrics' observers
  };

  explicit StatusPages(Parts parts);

  // Answers a request, on another thread: 401 without a valid token, 403 for a token of an agent,
  // 404 for an unknown path, 429 beyond the tenant's rate of listing, 503 if too many requests of
  // its client wait. /healthz needs no token, and answers 503 while the server does not serve. It
  // and /metrics wait for no other page.
  void Answer(HttpRequest request, HttpServer::Done done);

 private:
  // `round` is that of the page in `shared_`.
  void AnswerPage(const std::shared_ptr<const Credential>& caller, const HttpRequest& request,
                  SharedAnswers::Round& round, const HttpServer::Done& done);
  // Returns the delay of the answer to a refused caller.
  absl::Duration DelayOf(const absl::StatusOr<std::shared_ptr<const Credential>>& caller,
                         const absl::Status& refusal) const;
  HttpResponse Health() const;
  absl::StatusOr<std::string> Status(const Credential& caller, const HttpRequest& request) const;
  absl::StatusOr<std::string> History(const HttpRequest& request) const;
  absl::StatusOr<std::string> Session(const Credential& caller, const HttpRequest& request) const;
  absl::StatusOr<std::string> Sessions(const Credential& caller, const HttpRequest& request) const;
  absl::StatusOr<std::string> Usage(const Credential& caller, const HttpRequest& request) const;
  // Calls `done` when the background worker has explained the decision.
  void Explain(const std::shared_ptr<const Credential>& caller, const HttpRequest& request,
               const HttpServer::Done& done) const;

  // Streams the decisions of a session.
  void Watch(const std::shared_ptr<const Credential>& caller, const HttpRequest& request,
             const HttpServer::Done& done);

  const Parts parts_;
  SessionFeeds feeds_;
  SharedAnswers shared_;
  BackgroundWorker health_;
  BackgroundWorker metrics_;
  BackgroundWorker pages_;  // clients take turns
};

}  // namespace spikeserve
