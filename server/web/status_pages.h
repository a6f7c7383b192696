// Answers HTTP requests: /metrics, /healthz, and the status page with the JSON that it reads.
#ifndef SERVER_WEB_STATUS_PAGES_H_
#define SERVER_WEB_STATUS_PAGES_H_

#include <functional>
#include <map>
#include <memory>
#include <string>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "core/open_sessions/session_store.h"
#include "server/access/authenticator.h"
#include "server/admin/rollout_handler.h"
#include "server/agent/policy_handler.h"
#include "server/base/background_worker.h"
#include "server/base/replica_reports.h"
#include "server/base/replicas.h"
#include "server/history/server_history.h"
#include "server/metrics/metrics.h"
#include "server/web/http_server.h"
#include "server/web/session_feed.h"

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
    const ReplicaReports* reports;  // of these replicas
    double unusual_deviations;      // of the metrics' observers
  };

  explicit StatusPages(Parts parts);

  // Answers a request, on another thread: 401 without a valid token, 403 for a token of an agent,
  // 404 for an unknown path, 503 if too many requests of its client wait. /healthz needs no token,
  // waits for no other page, and answers 503 while the server does not serve.
  void Answer(const HttpRequest& request, const HttpServer::Done& done);

 private:
  // A list of sessions, to answer equal requests with.
  struct SessionList {
    std::shared_ptr<const Credential> caller;
    std::multimap<std::string, std::string> parameters;
    absl::Duration began = -absl::InfiniteDuration();  // time of the clock
    std::string json;
  };

  // `arrived` is the time of the clock at which the server received the request.
  void AnswerPage(const HttpRequest& request, absl::Duration arrived, const HttpServer::Done& done);
  HttpResponse Health() const;
  absl::StatusOr<std::string> Status(const Credential& caller, const HttpRequest& request) const;
  absl::StatusOr<std::string> History(const HttpRequest& request) const;
  absl::StatusOr<std::string> Session(const Credential& caller, const HttpRequest& request) const;
  // A request that waited while the list for an equal one was made gets that list. Therefore many
  // readers of one list wait for two passes over the sessions at most.
  absl::StatusOr<std::string> Sessions(const std::shared_ptr<const Credential>& caller,
                                       const HttpRequest& request, absl::Duration arrived);
  // Calls `done` when the background worker has explained the decision.
  void Explain(const std::shared_ptr<const Credential>& caller, const HttpRequest& request,
               const HttpServer::Done& done) const;

  // Streams the decisions of a session.
  void Watch(const std::shared_ptr<const Credential>& caller, const HttpRequest& request,
             const HttpServer::Done& done);

  const Parts parts_;
  SessionFeeds feeds_;
  absl::Mutex list_mutex_;
  SessionList last_list_ ABSL_GUARDED_BY(list_mutex_);
  BackgroundWorker health_;
  BackgroundWorker pages_;  // clients take turns
};

}  // namespace spikeserve

#endif  // SERVER_WEB_STATUS_PAGES_H_
