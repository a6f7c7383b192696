#include "server/server.h"

#include <malloc.h>
#include <sched.h>
#include <unistd.h>

#include <algorithm>
#include <optional>
#include <utility>
#include <vector>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/time/clock.h"
#include "absl/time/time.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "server/base/log.h"
#include "server/gauges.h"
#include "server/store/open_store.h"
#include "server/web/status_json.h"
#include "server/wiring_rules.h"

namespace spikeserve {
namespace {

// How long a stopping server keeps refusing calls with UNAVAILABLE, so that busy clients and health
// watchers learn that it stops. Clients retry UNAVAILABLE elsewhere; a connection that closes under
// a call can end it with a code that they do not retry.
constexpr absl::Duration kDrainNotice = absl::Milliseconds(250);

// Explanations, the lists of agents, and the calls of operators, some of which read and write
// files, run one at a time on a worker each. So many calls of a tenant may wait for it: few that
// take long, and many lists, which are short and come in bursts.
constexpr size_t kLongCallsWaiting = 16;
constexpr size_t kListsWaiting = 4096;
constexpr size_t kOperatorCallsWaiting = 16;

// The interval at which the tokens file is read again.
constexpr absl::Duration kTokensInterval = absl::Seconds(1);

// The interval of judging roll-outs.
constexpr absl::Duration kRolloutInterval = absl::Milliseconds(200);

// The interval of looking for what other servers have changed, and of saying that this one is
// alive.
constexpr absl::Duration kFollowInterval = absl::Milliseconds(250);

// How long a starting server waits for the heads that servers share, before it listens.
constexpr absl::Duration kJoinTimeout = absl::Seconds(2);

// The health page reports a server whose loops do not finish a turn within this time.
constexpr absl::Duration kHealthTimeout = absl::Seconds(1);

// The interval of looking whether the calls in flight have ended.
constexpr absl::Duration kDrainPollInterval = absl::Milliseconds(1);

// How long clients may take to read their last answers when the server stops.
constexpr absl::Duration kLeaveTimeout = absl::Seconds(1);

// The allocator keeps freed memory for later. After many connections were closed, for example those
// of an attack, or much was freed otherwise, for example by policies or tokens that were removed,
// it is given back to the system.
constexpr absl::Duration kTrimInterval = absl::Seconds(2);
constexpr int64_t kConnectionsToTrim = 16;
constexpr size_t kBytesToTrim = 16 << 20;

// Returns the number of cores that the process may use.
int AvailableCores() {
  cpu_set_t cores;
  CPU_ZERO(&cores);
  return sched_getaffinity(0, sizeof(cores), &cores) == 0 ? CPU_COUNT(&cores) : 1;
}

// Returns FAILED_PRECONDITION if nothing can be served and no operator wants that.
absl::Status CheckServesPolicies(const ServerOptions& options, const PolicyRegistry& registry,
                                 const ReloadReport& report) {
  if (options.allow_no_policies || !registry.catalog()->policies().empty()) {
    return absl::OkStatus();
  }
  absl::MutexLock change(&registry.settings().mutex);
  if (!registry.settings().get().unloaded.empty()) return absl::OkStatus();
  return absl::FailedPreconditionError(
      absl::StrCat("--policies: ", registry.folder().ExplainNone(report.refused)));
}

// Returns the address with the name of this machine instead of "all addresses".
std::string AddressForOthers(Address address) {
  char name[256] = "";
  const bool is_any = address.host == "0.0.0.0" || address.host == "[::]";
  if (is_any && gethostname(name, sizeof(name) - 1) == 0) address.host = name;
  return address.ToString();
}

// Returns null if nothing is to be traced.
absl::StatusOr<std::unique_ptr<Tracer>> StartTracing(const ServerOptions& options,
                                                     prometheus::Registry* registry) {
  if (!options.trace.enabled()) return nullptr;
  TraceOptions trace = options.trace;
  const std::string& store = options.store.address;
  if (absl::StartsWith(store, "redis")) trace.store_system = "redis";
  if (absl::StartsWith(store, "file:")) trace.store_system = "lmdb";
  return Tracer::Create(trace, registry);
}

absl::StatusOr<std::unique_ptr<PolicyRegistry>> LoadPolicies(const ServerOptions& options,
                                                             const OpenedStore& store,
                                                             Metrics* metrics, Tracer* tracer,
                                                             ReloadReport* report) {
  std::shared_ptr<const PolicySignatures> signatures;
  if (!options.trusted_keys.empty()) {
    ASSIGN_OR_RETURN(signatures, PolicySignatures::Read(options.trusted_keys, options.signing_key));
  }
  ASSIGN_OR_RETURN(const WiringRules wiring, ParseWiringRules(options.wiring));
  OpenHeadLog open_log;
  if (auto* const heads = store.heads.get(); heads != nullptr) {
    open_log = [heads](const ServedPolicy& served) { return heads->Open(served); };
  }
  const auto new_observer = [metrics, wiring, deviations = options.unusual_deviations](
                                const std::string& name, int64_t version, const Policy& policy) {
    const auto rule = wiring.find(name);
    const auto response = rule == wiring.end() ? wiring.at("") : rule->second;
    return metrics->NewPolicyObserver(name, version, policy, deviations, response);
  };
  return PolicyRegistry::Load({.directory = options.policies,
                               .settings_path = options.policy_settings,
                               .default_rule = options.default_version,
                               .withhold_files = options.withhold_policies,
                               .shared = store.shared.get(),
                               .signatures = std::move(signatures),
                               .loader = {.new_observer = new_observer,
                                          .share_heads = options.share_heads_across_tenants,
                                          .open_log = std::move(open_log),
                                          .tracer = tracer}},
                              report);
}

}  // namespace

absl::StatusOr<std::unique_ptr<Server>> Server::Start(const ServerOptions& options) {
  RETURN_IF_ERROR(options.Validate());
  ASSIGN_OR_RETURN(
      auto authenticator,
      Authenticator::Create(options.tokens, std::max<int64_t>(options.max_sessions / 2, 1)));
  auto metrics = std::make_unique<Metrics>();
  metrics->SetSessionsLimit(options.max_sessions);
  ASSIGN_OR_RETURN(auto tracer, StartTracing(options, &metrics->registry()));
  UsageStores usage(options.store, options.usage);
  ASSIGN_OR_RETURN(auto store, OpenStore(options.store, &metrics->registry(), usage.visitor()));
  RETURN_IF_ERROR(usage.Open());
  ReloadReport report;
  ASSIGN_OR_RETURN(auto registry,
                   LoadPolicies(options, store, metrics.get(), tracer.get(), &report));
  RETURN_IF_ERROR(CheckServesPolicies(options, *registry, report));
  for (const absl::Status& status : report.refused) {
    LogWarning("policy refused", {{"error", status.message()}});
  }
  for (const std::string& setting : report.waiting) {
    LogWarning("setting pending", {{"setting", setting}});
  }
  if (registry->catalog()->policies().empty()) {
    LogWarning("no policy is served", {{"policies", options.policies}});
  }

  ASSIGN_OR_RETURN(auto audit_log, AuditLog::Open(options.audit_log));
  std::unique_ptr<Recordings> recordings;
  if (!options.record_dir.empty()) {
    ASSIGN_OR_RETURN(recordings, Recordings::Create(options.record_dir, options.max_recorded_bytes,
                                                    metrics.get()));
  }
  auto server = std::unique_ptr<Server>(
      new Server(options, std::move(authenticator), std::move(registry), std::move(audit_log),
                 std::move(metrics), std::move(tracer), std::move(recordings), std::move(store),
                 std::move(usage)));
  server->StartLedger();
  if (server->shared_ != nullptr) {
    server->FollowReplicas();
    if (server->registry_->settings().has_joined()) server->heads_->WaitToJoin(kJoinTimeout);
  }
  RETURN_IF_ERROR(server->StartTransport());
  RETURN_IF_ERROR(server->StartHttp());
  if (server->certificates_.is_used()) server->certificates_.Start();
  if (options.poll_policies > absl::ZeroDuration()) {
    server->poller_ = std::make_unique<PolicyPoller>(server->registry_.get(), options.poll_policies,
                                                     report.refused);
  }
  Server* const started = server.get();
  if (server->shared_ != nullptr) {
    server->Every(kFollowInterval, [started] { started->FollowReplicas(); });
  }
  server->Every(kRolloutInterval, [started] { started->rollouts_.Tick(); });
  if (!options.tokens.empty()) {
    server->Every(kTokensInterval, [started] { started->ReloadTokens(); });
  }
  return server;
}

Server::Server(const ServerOptions& options, std::unique_ptr<Authenticator> authenticator,
               std::unique_ptr<PolicyRegistry> registry, std::unique_ptr<AuditLog> audit_log,
               std::unique_ptr<Metrics> metrics, std::unique_ptr<Tracer> tracer,
               std::unique_ptr<Recordings> recordings, OpenedStore store, UsageStores usage)
    : options_(options),
      authenticator_(std::move(authenticator)),
      metrics_(std::move(metrics)),
      tracer_(std::move(tracer)),
      shared_(std::move(store.shared)),
      heads_(std::move(store.heads)),
      replicas_(store.replica),
      registry_(std::move(registry)),
      files_(shared_ == nullptr ? nullptr
                                : std::make_unique<SharedFiles>(registry_.get(), shared_.get())),
      audit_log_(std::move(audit_log)),
      recordings_(std::move(recordings)),
      policy_folder_(options.policies, options.max_policy_bytes,
                     [metrics = metrics_.get()](int64_t bytes, int64_t limit) {
                       metrics->SetStoredBytes(StoredFolder::kPolicies, bytes, limit);
                     }),
      journals_(std::move(store.journals)),
      shadows_(metrics_->registry()),
      datagrams_(&clock_),
      store_(options.max_sessions, &clock_),
      ledger_({.process = usage.process,
               .label = options.usage.label,
               .session_life = options.store.retention,
               .tenant_metrics = options.usage.tenant_metrics,
               .is_shared = shared_ != nullptr},
              usage.books, usage.reads, usage.find_ownerless, &store_, authenticator_.get(),
              &clock_),
      reaper_(&store_,
              {.compact_after = options.compact_after, .time_to_live = options.session_ttl},
              [this](int64_t sessions) { metrics_->CountReaped(sessions); }),
      recovery_(journals_ == nullptr
                    ? nullptr
                    : std::make_unique<SessionRecovery>(journals_.get(), registry_.get(), &store_,
                                                        recordings_.get())),
      session_gate_(&store_, recovery_.get()),
      handler_(registry_.get(), &session_gate_, &shadows_, &clock_, recordings_.get(),
               {.journals = journals_.get(), .level = options.durability, .files = files_.get()},
               options.datagram_listen.empty() ? nullptr : &datagrams_),
      audit_(audit_log_.get(), registry_.get(), &store_, options.allow_unrecorded_changes),
      rollouts_(registry_.get(), metrics_.get(), &clock_, &replicas_,
                [this](const RolloutManager::Change& change) { audit_.Record(change); }),
      admin_handler_({.registry = registry_.get(),
                      .store = &store_,
                      .history = audit_log_.get(),
                      .replicas = &replicas_,
                      .files = files_.get(),
                      .journals = journals_.get(),
                      .rollouts = &rollouts_,
                      .folder = &policy_folder_,
                      .ledger = &ledger_,
                      .max_pushed = options.max_pushed_versions,
                      .on_draining = [this](bool) { PublishHealth(); }}),
      services_({.gate = &gate_,
                 .authenticator = authenticator_.get(),
                 .metrics = metrics_.get(),
                 .clock = &clock_,
                 .max_message_bytes = options.max_message_bytes,
                 .sessions = &session_gate_,
                 .tracer = tracer_.get(),
                 .datagrams = options.datagram_listen.empty() ? nullptr : &datagrams_},
                {.policy = &handler_,
                 .admin = &admin_handler_,
                 .audit = &audit_,
                 .inference = &inference_handler_,
                 .health = &health_,
                 .worker = &worker_,
                 .list_worker = &list_worker_,
                 .admin_worker = &admin_worker_,
                 .reflection_v1alpha = options.reflection_v1alpha}),
      // #lizard forgives(length): a list of members
      worker_(kLongCallsWaiting),
      list_worker_(kListsWaiting),
      admin_worker_(kOperatorCallsWaiting),
      inference_handler_(
          registry_.get(), &session_gate_, &handler_, &clock_, options.session_ttl,
          journals_ != nullptr && journals_->IsShared() && !options.allow_unconfirmed_sequences
              ? store.replica
              : ""),
      history_([this] { return metrics_->Collect(); }, &clock_),
      pages_({.authenticator = authenticator_.get(),
              .handler = &handler_,
              .admin = &admin_handler_,
              .store = &store_,
              .metrics = metrics_.get(),
              .history = &history_,
              .clock = &clock_,
              .worker = &worker_,
              .serving = [this] { return serving() && TransportResponds(); },
              .store_address = store.address,
              .replicas = &replicas_,
              .reports = &reports_,
              .unusual_deviations = options.unusual_deviations}) {}

absl::Status Server::StartTransport() {
  ASSIGN_OR_RETURN(auto address, ParseAddressOrUnix("--listen", options_.listen));
  if (options_.tls.enabled()) {
    ASSIGN_OR_RETURN(tls_, TlsContext::Create(options_.tls, Protocol::kHttp2));
    certificates_.Add(tls_.get());
  }
  metrics_->AddSource([this] { return CollectCertificates(certificates_); });
  metrics_->AddSource([this] { return CollectRobots(store_); });
  std::optional<Address> datagram_listen;
  if (!options_.datagram_listen.empty()) {
    ASSIGN_OR_RETURN(datagram_listen, ParseAddress("--datagram_listen", options_.datagram_listen));
    metrics_->AddSource([this] { return CollectDatagrams(datagrams_); });
  }
  metrics_->AddSource([this] { return CollectTraffic(*registry_->catalog()); });
  metrics_->AddSource([this] { return CollectHeads(*registry_->catalog()); });
  ASSIGN_OR_RETURN(
      auto transport,
      Transport::Create(
          {.listen = std::move(address),
           .datagram_listen = std::move(datagram_listen),
           .limits = options_.transport_limits,
           .loops = options_.loops == 0 ? AvailableCores() : static_cast<int>(options_.loops),
           .tls = tls_.get(),
           .clock = &clock_}));
  transport_ = std::move(transport);
  metrics_->AddSource([this] { return CollectConnections(*transport_); });
  grpc_address_ = transport_->address();
  datagrams_.SetEndpoint(options_.datagram_advertise.empty()
                             ? transport_->datagram_address().ToString()
                             : options_.datagram_advertise);
  PublishHealth();
  RETURN_IF_ERROR(services_.Attach(transport_.get()));
  Every(kTrimInterval, [this] { TrimMemory(); });
  return transport_->Start();
}

void Server::StartLedger() {
  store_.SetOnClosed([this](SessionEntry& entry) { ledger_.OnClosed(entry); });
  if (journals_ != nullptr) journals_->Keep(&store_, [this] { ledger_.BookEnds(); });
  metrics_->AddSource([this] { return ledger_.Collect(); });
  ledger_.FollowMonth();  // so that what is spent is known before the first session
  Every(options_.usage.interval, [this] { ledger_.Tick(); });
}

void Server::TrimMemory() {
  const int64_t closed = transport_->connections().counts().closed;
  const bool many_closed = closed - std::exchange(trimmed_at_, closed) >= kConnectionsToTrim;
  // What was given back still counts as free, so only what was freed since then matters.
  const size_t free_bytes = mallinfo2().fordblks;
  free_when_trimmed_ = std::min(free_when_trimmed_, free_bytes);
  if (!many_closed && free_bytes - free_when_trimmed_ < kBytesToTrim) return;
  malloc_trim(0);
  free_when_trimmed_ = free_bytes;
}

bool Server::TransportResponds() const {
  return transport_ == nullptr || transport_->Responds(kHealthTimeout);
}

void Server::PublishHealth() {
  health_.SetServing("", serving());
  health_.SetServing(MethodOf<v1::ListPoliciesRequest>().service, serving());
  health_.SetServing(MethodOf<inference::ServerLiveRequest>().service, serving());
  health_.SetServing(MethodOf<v1::LoadPolicyRequest>().service, !stopping_);
}

void Server::FollowReplicas() {
  auto status = registry_->Follow();
  heads_->SetFollowing(status.ok());
  if (status.ok()) {
    auto alive = shared_->Heartbeat();
    status = alive.status();
    if (alive.ok()) {
      replicas_.SetAlive(*alive);
      std::ranges::sort(*alive);
      if (!std::ranges::includes(*alive, alive_)) ledger_.OnServerGone();
      alive_ = *alive;
      status = files_->Follow(*alive);
    }
  }
  authenticator_->SetReplicas(replicas_.count());
  if (transport_ != nullptr && !joined_ && has_joined()) {
    joined_ = true;
    PublishHealth();
  }
  const bool fails = !status.ok();
  if (fails && !std::exchange(follow_failed_, fails)) {
    LogError("settings not shared; tries again", {{"error", status.message()}});
  }
  follow_failed_ = fails;
}

void Server::ReportToReplicas() {
  const std::string report =
      ServerReport(history_.Summary(), AddressForOthers(http_->address()), serving());
  auto reports = shared_->Report(report, clock_.Now());
  // FollowReplicas() logs that the store is away. Until it is back, the reports grow old.
  if (reports.ok()) reports_.Set(*std::move(reports));
}

void Server::ReleaseSessions() {
  const auto is_stored = [](const SessionEntry& entry) { return entry.journal != nullptr; };
  store_.ForEach(is_stored, [](const ListedSession& session) {
    absl::MutexLock lock(&session.entry->mutex);
    session.entry->journal->OnRelease(session.entry->agent.session());
  });
}

void Server::ReloadTokens() {
  if (auto status = authenticator_->Reload(); !status.ok()) {
    LogError("token file not reloaded; the old tokens stay valid", {{"error", status.message()}});
  }
}

absl::Status Server::StartHttp() {
  if (options_.http_listen.empty()) return absl::OkStatus();
  ASSIGN_OR_RETURN(const auto address, ParseAddress("--http_listen", options_.http_listen));
  // A browser sends a page of another site, whose name resolves to this machine, with that name.
  // With tokens such a page learns nothing, because it has none.
  const bool local_names_only = address.is_loopback() && options_.tokens.empty();
  if (options_.tls.enabled()) {
    ASSIGN_OR_RETURN(http_tls_, TlsContext::Create(options_.tls, Protocol::kHttp1));
    certificates_.Add(http_tls_.get());
  }
  http_calls_ = std::make_unique<HttpCalls>(
      HttpCalls::Parts{.transport = transport_.get(),
                       .authenticator = authenticator_.get(),
                       .metrics = metrics_.get(),
                       .clock = &clock_,
                       .limits = options_.transport_limits,
                       .max_message_bytes = options_.max_message_bytes});
  inference_pages_ = std::make_unique<const InferencePages>(http_calls_.get());
  grpc_web_pages_ = std::make_unique<const GrpcWebPages>(http_calls_.get());
  const InferencePages& inference = *inference_pages_;
  const GrpcWebPages& grpc_web = *grpc_web_pages_;
  ASSIGN_OR_RETURN(
      auto http,
      HttpServer::Start({.listen = address,
                         .tls = http_tls_.get(),
                         .local_names_only = local_names_only,
                         .origins = *Origins::Parse("--http_origins", options_.http_origins),
                         .clock = &clock_,
                         .accept_body =
                             [&inference, &grpc_web](const HttpRequest& request) {
                               return GrpcWebPages::Has(request) ? grpc_web.AcceptBody(request)
                                                                 : inference.AcceptBody(request);
                             }},
                        [this, &inference, &grpc_web](HttpRequest request, HttpServer::Done done) {
                          if (GrpcWebPages::Has(request)) {
                            return grpc_web.Answer(std::move(request), std::move(done));
                          }
                          if (InferencePages::Has(request.path)) {
                            return inference.Answer(std::move(request), std::move(done));
                          }
                          pages_.Answer(std::move(request), std::move(done));
                        }));
  http_ = std::move(http);
  Every(ServerHistory::kInterval, [this] { history_.Tick(); });
  if (shared_ != nullptr) Every(ServerHistory::kInterval, [this] { ReportToReplicas(); });
  return absl::OkStatus();
}

Server::~Server() { Stop(); }

void Server::Stop() {
  if (stopping_.exchange(true)) return;
  poller_.reset();
  periodic_.clear();
  rollouts_.SaveEvidence();
  if (shared_ != nullptr) shared_->Leave().IgnoreError();  // the others find out in any case
  if (transport_ != nullptr) StopTransport();
  if (journals_ != nullptr) journals_->Stop(absl::ZeroDuration());  // it uses the sessions
  ledger_.BookAll();  // what the last answers have used
  http_.reset();
  if (tracer_ != nullptr) tracer_->Stop();
  metrics_->KeepSeries();
}

void Server::StopTransport() {
  gate_.Drain();  // before health turns NOT_SERVING: a client that sees it is not served any more
  transport_->Drain();
  PublishHealth();
  absl::SleepFor(kDrainNotice);
  const absl::Duration end = clock_.Now() + options_.drain_timeout;
  while (gate_.calls() > 0 && clock_.Now() < end) absl::SleepFor(kDrainPollInterval);
  if (gate_.calls() > 0) {
    LogWarning("calls were still in flight after the drain timeout",
               {{"drain_timeout", absl::FormatDuration(options_.drain_timeout)}});
  }
  health_.EndWatches();
  transport_->Stop(kLeaveTimeout);
  if (journals_ == nullptr) return;
  ReleaseSessions();
  const bool reachable = journals_->CheckReachable().ok();
  journals_->Stop(reachable ? std::max(kLeaveTimeout, end - clock_.Now()) : kLeaveTimeout);
  if (heads_ != nullptr) heads_->Stop(kLeaveTimeout);
  recovery_->ForgetWaiters();
}

}  // namespace spikeserve
