#include "server/parts.h"

#include <malloc.h>
#include <sched.h>

#include <algorithm>
#include <optional>
#include <utility>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "server/base/log.h"
#include "server/wiring_rules.h"

namespace spikeserve {
namespace {

// Explanations, the lists of agents, and the calls of operators, some of which read and write
// files, run one at a time on a worker each. So many calls of a tenant may wait for it: few that
// take long, and many lists, which are short and come in bursts.
constexpr size_t kLongCallsWaiting = 16;
constexpr size_t kListsWaiting = 4096;
constexpr size_t kOperatorCallsWaiting = 16;

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
                                                             const Foundation& base,
                                                             ReloadReport* report) {
  std::shared_ptr<const PolicySignatures> signatures;
  if (!options.trusted_keys.empty()) {
    ASSIGN_OR_RETURN(signatures, PolicySignatures::Read(options.trusted_keys, options.signing_key));
  }
  ASSIGN_OR_RETURN(const WiringRules wiring, ParseWiringRules(options.wiring));
  OpenHeadLog open_log;
  if (auto* const heads = base.store.heads.get(); heads != nullptr) {
    open_log = [heads](const ServedPolicy& served) { return heads->Open(served); };
  }
  const auto new_observer = [metrics = base.metrics.get(), wiring,
                             deviations = options.unusual_deviations](
                                const std::string& name, int64_t version, const Policy& policy) {
    const auto rule = wiring.find(name);
    const auto response = rule == wiring.end() ? wiring.at("") : rule->second;
    return metrics->NewPolicyObserver(name, version, policy, deviations, response);
  };
  return PolicyRegistry::Load({.directory = options.policies,
                               .settings_path = options.policy_settings,
                               .default_rule = options.default_version,
                               .withhold_files = options.withhold_policies,
                               .shared = base.store.shared.get(),
                               .signatures = std::move(signatures),
                               .loader = {.new_observer = new_observer,
                                          .share_heads = options.share_heads_across_tenants,
                                          .open_log = std::move(open_log),
                                          .tracer = base.tracer.get()}},
                              report);
}

}  // namespace

absl::StatusOr<Foundation> Foundation::Open(const ServerOptions& options, ReloadReport* report) {
  Foundation base = {.usage = UsageStores(options.store, options.usage)};
  ASSIGN_OR_RETURN(
      base.authenticator,
      Authenticator::Create(options.tokens, std::max<int64_t>(options.max_sessions / 2, 1)));
  base.metrics->SetSessionsLimit(options.max_sessions);
  ASSIGN_OR_RETURN(base.tracer, StartTracing(options, &base.metrics->registry()));
  ASSIGN_OR_RETURN(base.store,
                   OpenStore(options.store, &base.metrics->registry(), base.usage.visitor()));
  base.journals = std::move(base.store.journals);
  RETURN_IF_ERROR(base.usage.Open());
  ASSIGN_OR_RETURN(base.registry, LoadPolicies(options, base, report));
  RETURN_IF_ERROR(CheckServesPolicies(options, *base.registry, *report));
  for (const absl::Status& status : report->refused) {
    LogWarning("policy refused", {{"error", status.message()}});
  }
  for (const std::string& setting : report->waiting) {
    LogWarning("setting pending", {{"setting", setting}});
  }
  if (base.registry->catalog()->policies().empty()) {
    LogWarning("no policy is served", {{"policies", options.policies}});
  }
  ASSIGN_OR_RETURN(base.audit_log, AuditLog::Open(options.audit_log));
  if (!options.record_dir.empty()) {
    ASSIGN_OR_RETURN(
        base.recordings,
        Recordings::Create(options.record_dir, options.max_recorded_bytes, base.metrics.get()));
  }
  return base;
}

Membership::Membership(const Foundation* base)
    : base_(*base),
      replicas_(base->store.replica),
      files_(!is_shared()
                 ? nullptr
                 : std::make_unique<SharedFiles>(base->registry.get(), base->store.shared.get())) {}

bool Membership::has_joined() const {
  const HeadLogStore* const heads = base_.store.heads.get();
  return base_.registry->settings().has_joined() && (heads == nullptr || heads->has_joined());
}

bool Membership::Follow() {
  bool is_one_gone = false;
  auto status = base_.registry->Follow();
  base_.store.heads->SetFollowing(status.ok());
  if (status.ok()) {
    auto alive = base_.store.shared->Heartbeat();
    status = alive.status();
    if (alive.ok()) {
      replicas_.SetAlive(*alive);
      std::ranges::sort(*alive);
      is_one_gone = !std::ranges::includes(*alive, alive_);
      alive_ = *alive;
      status = files_->Follow(*alive);
    }
  }
  base_.authenticator->SetReplicas(replicas_.count());
  if (const bool failed = std::exchange(fails_, !status.ok()); fails_ && !failed) {
    LogError("settings not shared; tries again", {{"error", status.message()}});
  }
  return is_one_gone;
}

void Membership::Report(const std::string& report, absl::Duration now) {
  auto reports = base_.store.shared->Report(report, now);
  // Follow() logs that the store is away. Until it is back, the reports grow old.
  if (reports.ok()) reports_.Set(*std::move(reports));
}

Sessions::Sessions(const ServerOptions& options, const Foundation& base, Membership* membership,
                   const Clock* clock)
    : shadows(base.metrics->registry()),
      datagrams(clock),
      store(options.max_sessions, clock),
      ledger({.process = base.usage.process,
              .label = options.usage.label,
              .session_life = options.store.retention,
              .tenant_metrics = options.usage.tenant_metrics,
              .is_shared = membership->is_shared()},
             base.usage.books, base.usage.reads, base.usage.find_ownerless, &store,
             base.authenticator.get(), clock),
      reaper(&store, {.compact_after = options.compact_after, .time_to_live = options.session_ttl},
             [metrics = base.metrics.get()](int64_t count) { metrics->CountReaped(count); }),
      recovery(base.journals == nullptr
                   ? nullptr
                   : std::make_unique<SessionRecovery>(base.journals.get(), base.registry.get(),
                                                       &store, base.recordings.get())),
      gate(&store, recovery.get()),
      handler(base.registry.get(), &gate, &shadows, clock, base.recordings.get(),
              {.journals = base.journals.get(),
               .level = options.durability,
               .files = membership->files()},
              options.datagram_listen.empty() ? nullptr : &datagrams),
      inference(
          base.registry.get(), &gate, &handler, clock, options.session_ttl,
          [membership] { return membership->has_joined(); },
          recovery != nullptr && base.journals->IsShared() && !options.allow_unconfirmed_sequences
              ? base.store.replica
              : "") {}

void Sessions::Release() {
  const auto is_stored = [](const SessionEntry& entry) { return entry.journal != nullptr; };
  store.ForEach(is_stored, [](const ListedSession& session) {
    absl::MutexLock lock(&session.entry->mutex);
    session.entry->journal->OnRelease(session.entry->agent.session());
  });
}

Operators::Operators(const ServerOptions& options, const Foundation& base, Membership* membership,
                     Sessions* sessions, const Clock* clock, std::function<void(bool)> on_draining)
    : policy_folder(options.policies, options.max_policy_bytes,
                    [metrics = base.metrics.get()](int64_t bytes, int64_t limit) {
                      metrics->SetStoredBytes(StoredFolder::kPolicies, bytes, limit);
                    }),
      audit(base.audit_log.get(), base.registry.get(), &sessions->store,
            options.allow_unrecorded_changes),
      rollouts(base.registry.get(), base.metrics.get(), clock, membership->replicas(),
               [this](const RolloutManager::Change& change) { audit.Record(change); }),
      handler({.registry = base.registry.get(),
               .store = &sessions->store,
               .history = base.audit_log.get(),
               .replicas = membership->replicas(),
               .files = membership->files(),
               .journals = base.journals.get(),
               .rollouts = &rollouts,
               .folder = &policy_folder,
               .ledger = &sessions->ledger,
               .max_pushed = options.max_pushed_versions,
               .on_draining = std::move(on_draining)}),
      history([metrics = base.metrics.get()] { return metrics->Collect(); }, clock) {}

GrpcDoor::GrpcDoor(const ServerOptions& options, const Foundation& base, Sessions* sessions,
                   const Operators& operators, const Clock* clock)
    : services({.gate = &gate,
                .authenticator = base.authenticator.get(),
                .metrics = base.metrics.get(),
                .clock = clock,
                .max_message_bytes = options.max_message_bytes,
                .sessions = &sessions->gate,
                .tracer = base.tracer.get(),
                .datagrams = options.datagram_listen.empty() ? nullptr : &sessions->datagrams},
               {.policy = &sessions->handler,
                .admin = &operators.handler,
                .audit = &operators.audit,
                .inference = &sessions->inference,
                .health = &health,
                .worker = &worker,
                .list_worker = &list_worker,
                .admin_worker = &admin_worker,
                .reflection_v1alpha = options.reflection_v1alpha}),
      worker(kLongCallsWaiting),
      list_worker(kListsWaiting),
      admin_worker(kOperatorCallsWaiting) {}

absl::Status GrpcDoor::Open(const ServerOptions& options, const Clock* clock) {
  ASSIGN_OR_RETURN(auto address, ParseAddressOrUnix("--listen", options.listen));
  if (options.tls.enabled()) {
    ASSIGN_OR_RETURN(tls, TlsContext::Create(options.tls, Protocol::kHttp2));
  }
  std::optional<Address> datagram_listen;
  if (!options.datagram_listen.empty()) {
    ASSIGN_OR_RETURN(datagram_listen, ParseAddress("--datagram_listen", options.datagram_listen));
  }
  ASSIGN_OR_RETURN(transport,
                   Transport::Create({.listen = std::move(address),
                                      .datagram_listen = std::move(datagram_listen),
                                      .limits = options.transport_limits,
                                      .loops = options.loops == 0 ? AvailableCores()
                                                                  : static_cast<int>(options.loops),
                                      .tls = tls.get(),
                                      .clock = clock}));
  return absl::OkStatus();
}

absl::Status HttpDoor::Open(const ServerOptions& options, const Foundation& base,
                            Transport* transport, const Clock* clock) {
  if (options.http_listen.empty()) return absl::OkStatus();
  ASSIGN_OR_RETURN(const auto address, ParseAddress("--http_listen", options.http_listen));
  // A browser sends a page of another site, whose name resolves to this machine, with that name.
  // With tokens such a page learns nothing, because it has none.
  const bool local_names_only = address.is_loopback() && options.tokens.empty();
  if (options.tls.enabled()) {
    ASSIGN_OR_RETURN(tls, TlsContext::Create(options.tls, Protocol::kHttp1));
  }
  calls =
      std::make_unique<HttpCalls>(HttpCalls::Parts{.transport = transport,
                                                   .authenticator = base.authenticator.get(),
                                                   .metrics = base.metrics.get(),
                                                   .clock = clock,
                                                   .limits = options.transport_limits,
                                                   .max_message_bytes = options.max_message_bytes});
  for (const auto add : {NewSeatPages, NewGrpcWebPages, NewInferencePages}) {
    call_pages.push_back(add(calls.get()));
  }
  const auto accept_body =
      [this](const HttpRequest& request) -> std::variant<AcceptedBody, HttpResponse> {
    if (const CallPages* of_call = CallPagesFor(request)) return of_call->AcceptBody(request);
    return HttpResponse{.code = 405, .body = "expected GET or HEAD\n"};
  };
  const auto answer = [this](HttpRequest request, HttpServer::Done done) {
    if (const CallPages* of_call = CallPagesFor(request)) {
      return of_call->Answer(std::move(request), std::move(done));
    }
    pages.Answer(std::move(request), std::move(done));
  };
  ASSIGN_OR_RETURN(
      server, HttpServer::Start({.listen = address,
                                 .tls = tls.get(),
                                 .local_names_only = local_names_only,
                                 .has_tokens = !options.tokens.empty(),
                                 .origins = *Origins::Parse("--http_origins", options.http_origins),
                                 .clock = clock,
                                 .accept_body = accept_body},
                                answer));
  return absl::OkStatus();
}

const CallPages* HttpDoor::CallPagesFor(const HttpRequest& request) const {
  for (const auto& of_call : call_pages) {
    if (of_call->Has(request)) return of_call.get();
  }
  return nullptr;
}

void MemoryTrimmer::Trim(int64_t closed_connections) {
  const bool many_closed =
      closed_connections - std::exchange(closed_, closed_connections) >= kConnectionsToTrim;
  // What was given back still counts as free, so only what was freed since then matters.
  const size_t free_bytes = mallinfo2().fordblks;
  free_ = std::min(free_, free_bytes);
  if (!many_closed && free_bytes - free_ < kBytesToTrim) return;
  malloc_trim(0);
  free_ = free_bytes;
}

}  // namespace spikeserve
