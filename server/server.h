// A running server: creates all parts of the server, and starts and stops them in order.
#pragma once

#include <atomic>
#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/clock.h"
#include "core/open_sessions/session_reaper.h"
#include "core/open_sessions/session_store.h"
#include "server/access/authenticator.h"
#include "server/access/certificate_watch.h"
#include "server/access/tls_context.h"
#include "server/admin/admin_handler.h"
#include "server/admin/audit.h"
#include "server/admin/audit_log.h"
#include "server/agent/datagram_channels.h"
#include "server/agent/policy_handler.h"
#include "server/agent/session_gate.h"
#include "server/agent/session_recovery.h"
#include "server/base/address.h"
#include "server/base/background_worker.h"
#include "server/base/periodic.h"
#include "server/base/replica_reports.h"
#include "server/base/replicas.h"
#include "server/followers/recordings.h"
#include "server/followers/shadow_runner.h"
#include "server/history/server_history.h"
#include "server/inference/inference_handler.h"
#include "server/metrics/metrics.h"
#include "server/options.h"
#include "server/policies/policy_poller.h"
#include "server/policies/policy_registry.h"
#include "server/rollouts/rollout_manager.h"
#include "server/services/call_gate.h"
#include "server/services/health_service.h"
#include "server/services/services.h"
#include "server/store/open_store.h"
#include "server/trace/tracer.h"
#include "server/transport/transport.h"
#include "server/usage/ledger.h"
#include "server/usage/open_usage.h"
#include "server/web/grpc_web_pages.h"
#include "server/web/http_call.h"
#include "server/web/http_server.h"
#include "server/web/inference_pages.h"
#include "server/web/status_pages.h"

namespace spikeserve {

//   ServerOptions options;
//   options.policies = "deploy/policies";
//   auto server = Server::Start(options);
//   if (server.ok()) std::cout << (*server)->grpc_address();
//
// Not thread-safe: one thread starts and stops it.
class Server {
 public:
  // Loads the policies and starts serving before it returns. Logs one line for each policy that
  // cannot be loaded. Errors name the flag that is wrong.
  static absl::StatusOr<std::unique_ptr<Server>> Start(const ServerOptions& options);

  // Calls Stop() if it was not called.
  ~Server();

  // The addresses that the server listens on, as HOST:PORT. Without HTTP, http_address() is empty,
  // and without datagrams, datagram_address() is.
  std::string grpc_address() const { return grpc_address_.ToString(); }
  std::string datagram_address() const {
    return options_.datagram_listen.empty() ? "" : transport_->datagram_address().ToString();
  }
  std::string http_address() const { return http_ == nullptr ? "" : http_->address().ToString(); }

  // Stops gracefully: refuses new calls with UNAVAILABLE, sets health to NOT_SERVING, and waits at
  // most ServerOptions::drain_timeout for the answers of calls in flight.
  void Stop();

 private:
  Server(const ServerOptions& options, std::unique_ptr<Authenticator> authenticator,
         std::unique_ptr<PolicyRegistry> registry, std::unique_ptr<AuditLog> audit_log,
         std::unique_ptr<Metrics> metrics, std::unique_ptr<Tracer> tracer,
         std::unique_ptr<Recordings> recordings, OpenedStore store, UsageStores usage);

  // Calls `work` at this interval until the server stops.
  void Every(absl::Duration interval, std::function<void()> work) {
    periodic_.push_back(std::make_unique<Periodic>(interval, std::move(work)));
  }
  void ReloadTokens();
  void StartLedger();
  absl::Status StartTransport();
  void StopTransport();
  // Says that this server is alive, and takes over what the others have changed.
  void FollowReplicas();
  // Sends the report of this server to the status pages of the others.
  void ReportToReplicas();
  // Writes a last snapshot of every stored session, from which another server continues.
  void ReleaseSessions();
  absl::Status StartHttp();
  // False until the settings and the heads that servers share were taken over, too.
  bool serving() const { return !stopping_ && !store_.draining() && has_joined(); }
  bool has_joined() const {
    return registry_->settings().has_joined() && (heads_ == nullptr || heads_->has_joined());
  }
  // Returns true unless the loops of the transport are stuck.
  bool TransportResponds() const;
  void TrimMemory();
  void PublishHealth();

  const ServerOptions options_;
  const SteadyClock clock_;
  const std::unique_ptr<Authenticator> authenticator_;
  const std::unique_ptr<Metrics> metrics_;
  const std::unique_ptr<Tracer> tracer_;       // null: nothing is traced
  const std::unique_ptr<RedisShared> shared_;  // null: this server shares nothing
  const std::unique_ptr<HeadLogStore> heads_;  // null as `shared_`
  Replicas replicas_;
  ReplicaReports reports_;
  const std::unique_ptr<PolicyRegistry> registry_;
  const std::unique_ptr<SharedFiles> files_;  // null as `shared_`
  const std::unique_ptr<AuditLog> audit_log_;
  const std::unique_ptr<Recordings> recordings_;  // null without --record_dir; outlives the store
  SharedFolder policy_folder_;
  const std::unique_ptr<JournalStore> journals_;  // null: no session is stored
  ShadowRunner shadows_;
  DatagramChannels datagrams_;
  SessionStore store_;
  Ledger ledger_;
  SessionReaper reaper_;
  const std::unique_ptr<SessionRecovery> recovery_;  // null as `journals_`
  const SessionGate session_gate_;
  const PolicyHandler handler_;
  const Audit audit_;
  RolloutManager rollouts_;
  const AdminHandler admin_handler_;
  CallGate gate_;
  HealthService health_;
  std::unique_ptr<TlsContext> tls_;  // null without TLS
  // Calls refer to the services, the transport holds calls, and the workers post to its loops.
  Services services_;
  std::unique_ptr<Transport> transport_;
  BackgroundWorker worker_;
  BackgroundWorker list_worker_;
  BackgroundWorker admin_worker_;
  const InferenceHandler inference_handler_;
  std::atomic<bool> stopping_ = false;
  // State of FollowReplicas(), which one thread calls at a time.
  bool follow_failed_ = false;
  std::vector<std::string> alive_;  // servers, sorted
  bool joined_ = false;             // the value that was published last
  // When memory was last given back: connections closed, and free bytes.
  int64_t trimmed_at_ = 0;
  size_t free_when_trimmed_ = 0;
  ServerHistory history_;
  StatusPages pages_;
  std::unique_ptr<HttpCalls> http_calls_;  // null as `http_`; its calls are on loops of transport_
  std::unique_ptr<const InferencePages> inference_pages_;  // null as `http_`
  std::unique_ptr<const GrpcWebPages> grpc_web_pages_;     // null as `http_`
  Address grpc_address_;
  std::unique_ptr<TlsContext> http_tls_;  // null without TLS
  std::unique_ptr<HttpServer> http_;
  CertificateWatch certificates_;  // of both ports; its thread uses them
  // Declared last, because their threads use the members above.
  std::unique_ptr<PolicyPoller> poller_;
  std::vector<std::unique_ptr<Periodic>> periodic_;
};

}  // namespace spikeserve
