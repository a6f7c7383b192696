// The parts that a server is made of, each of which uses only those above it.
//
// Each member states its own thread-safety; one thread makes and destroys the parts.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
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
#include "server/base/live_servers.h"
#include "server/base/replica_reports.h"
#include "server/followers/recordings.h"
#include "server/followers/shadow_runner.h"
#include "server/history/server_history.h"
#include "server/inference/inference_handler.h"
#include "server/metrics/metrics.h"
#include "server/options.h"
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
#include "server/web/call_pages.h"
#include "server/web/http_call.h"
#include "server/web/http_server.h"
#include "server/web/status_pages.h"

namespace spikeserve {

// What is opened before anything is served.
struct Foundation {
  // Loads the policies. Logs one line for each that cannot be loaded, and returns these lines in
  // `report`. Errors name the flag that is wrong.
  static absl::StatusOr<Foundation> Open(const ServerOptions& options, ReloadReport* report);

  std::unique_ptr<Authenticator> authenticator = nullptr;
  std::unique_ptr<Metrics> metrics = std::make_unique<Metrics>();
  std::unique_ptr<Tracer> tracer = nullptr;  // null: nothing is traced
  OpenedStore store = {};
  UsageStores usage;
  std::unique_ptr<PolicyRegistry> registry = nullptr;
  std::unique_ptr<AuditLog> audit_log = nullptr;
  std::unique_ptr<Recordings> recordings = nullptr;  // null without --record_dir
  std::unique_ptr<JournalStore> journals = nullptr;  // that of `store`; null: nothing is stored
};

// This server among those that share its store.
class Membership {
 public:
  explicit Membership(const Foundation* base);

  bool is_shared() const { return base_.store.shared != nullptr; }
  // True once the settings and the heads that servers share were taken over, or nothing is shared.
  bool has_joined() const;
  LiveServers* replicas() { return &replicas_; }
  const ReplicaReports* reports() const { return &reports_; }
  SharedFiles* files() { return files_.get(); }  // null: nothing is shared

  // Says that this server is alive, and takes over what the others have changed. Returns true if
  // one of them has gone. One thread at a time calls it.
  bool Follow();
  // Sends the report of this server to the status pages of the others.
  void Report(const std::string& report, absl::Duration now);

 private:
  const Foundation& base_;
  LiveServers replicas_;
  ReplicaReports reports_;
  const std::unique_ptr<SharedFiles> files_;
  // Of Follow():
  bool fails_ = false;
  std::vector<std::string> alive_;  // servers, sorted
};

// The sessions that are open: what opens, decides, keeps, books and ends them.
struct Sessions {
  Sessions(const ServerOptions& options, const Foundation& base, Membership* membership,
           const Clock* clock);

  // Writes a last snapshot of every stored session, from which another server continues.
  void Release();

  ShadowRunner shadows;
  DatagramChannels datagrams;
  SessionStore store;
  Ledger ledger;
  SessionReaper reaper;
  const std::unique_ptr<SessionRecovery> recovery;  // null: no session is stored
  const SessionGate gate;
  const PolicyHandler handler;
  const InferenceHandler inference;
};

// What operators call and see.
struct Operators {
  Operators(const ServerOptions& options, const Foundation& base, Membership* membership,
            Sessions* sessions, const Clock* clock, std::function<void(bool)> on_draining);

  SharedFolder policy_folder;
  const Audit audit;
  RolloutManager rollouts;
  const AdminHandler handler;
  ServerHistory history;
};

// The ports for gRPC and datagrams. Calls refer to the services, the transport holds calls, and the
// workers post to its loops.
struct GrpcDoor {
  GrpcDoor(const ServerOptions& options, const Foundation& base, Sessions* sessions,
           const Operators& operators, const Clock* clock);

  // Opens the ports; Transport::Start() begins to answer.
  absl::Status Open(const ServerOptions& options, const Clock* clock);

  CallGate gate;
  HealthService health;
  std::unique_ptr<TlsContext> tls = nullptr;  // null without TLS
  Services services;
  std::unique_ptr<Transport> transport = nullptr;  // null before Open()
  BackgroundWorker worker;
  BackgroundWorker list_worker;
  BackgroundWorker admin_worker;
};

// The port for HTTP.
struct HttpDoor {
  explicit HttpDoor(StatusPages::Parts parts) : pages(std::move(parts)) {}

  // Opens the port unless --http_listen is empty. Its calls are on loops of `transport`.
  absl::Status Open(const ServerOptions& options, const Foundation& base, Transport* transport,
                    const Clock* clock);
  // Returns the pages that answer a request; null: `pages` do.
  const CallPages* CallPagesFor(const HttpRequest& request) const;

  StatusPages pages;
  // The rest is null, or empty, without --http_listen.
  std::unique_ptr<HttpCalls> calls = nullptr;
  std::vector<std::unique_ptr<const CallPages>> call_pages = {};  // the first that has a request
  std::unique_ptr<TlsContext> tls = nullptr;                      // null without TLS, too
  std::unique_ptr<HttpServer> server = nullptr;
};

// Gives memory back to the system. The allocator keeps freed memory for later; after many
// connections were closed, for example those of an attack, or much was freed otherwise, for example
// by policies or tokens that were removed, it is given back. Not thread-safe.
class MemoryTrimmer {
 public:
  void Trim(int64_t closed_connections);

 private:
  // When memory was last given back: connections closed, and free bytes.
  int64_t closed_ = 0;
  size_t free_ = 0;
};

}  // namespace spikeserve
