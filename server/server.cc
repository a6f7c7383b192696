#include "server/server.h"

#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/time/clock.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "core/base/status_macros.h"
#include "server/access/certificate_watch.h"
#include "server/base/log.h"
#include "server/base/periodic.h"
#include "server/gauges.h"
#include "server/parts.h"
#include "server/policies/policy_poller.h"
#include "server/web/status_json.h"

namespace spikeserve {
namespace {

// How long a stopping server keeps refusing calls with UNAVAILABLE, so that busy clients and health
// watchers learn that it stops. Clients retry UNAVAILABLE elsewhere; a connection that closes under
// a call can end it with a code that they do not retry.
constexpr absl::Duration kDrainNotice = absl::Milliseconds(250);

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

// The interval of giving freed memory back to the system.
constexpr absl::Duration kTrimInterval = absl::Seconds(2);

// Returns the address with the name of this machine instead of "all addresses".
std::string AddressForOthers(Address address) {
  char name[256] = "";
  const bool is_any = address.host == "0.0.0.0" || address.host == "[::]";
  if (is_any && gethostname(name, sizeof(name) - 1) == 0) address.host = name;
  return address.ToString();
}

class RunningServer : public Server {
 public:
  // `base` has the policies.
  RunningServer(const ServerOptions& options, Foundation base);
  ~RunningServer() override;

  // Starts what the server consists of. `refused` are the policies that could not be loaded.
  absl::Status Begin(const std::vector<absl::Status>& refused);

  std::string grpc_address() const override { return grpc_.transport->address().ToString(); }
  std::string datagram_address() const override {
    return options_.datagram_listen.empty() ? "" : grpc_.transport->datagram_address().ToString();
  }
  std::string http_address() const override {
    return http_.server == nullptr ? "" : http_.server->address().ToString();
  }
  void Stop() override;

 private:
  // Calls `work` at this interval until the server stops.
  void Every(absl::Duration interval, std::function<void()> work) {
    periodic_.push_back(std::make_unique<Periodic>(interval, std::move(work)));
  }
  void ReloadTokens();
  void StartLedger();
  absl::Status StartTransport();
  void StopTransport();
  absl::Status StartHttp();
  // Follows the other servers, and says so when this one has joined them.
  void FollowReplicas();
  // False until the settings and the heads that servers share were taken over, too.
  bool serving() const {
    return !stopping_ && !sessions_.store.draining() && membership_.has_joined();
  }
  // Returns true unless the loops of the transport are stuck.
  bool TransportResponds() const;
  void PublishHealth();

  const ServerOptions options_;
  const SteadyClock clock_;
  const Foundation base_;
  Membership membership_;
  Sessions sessions_;
  Operators operators_;
  GrpcDoor grpc_;
  HttpDoor http_;
  CertificateWatch certificates_;  // of both doors; its thread uses them
  MemoryTrimmer memory_;
  std::atomic<bool> stopping_ = false;
  bool joined_ = false;  // the value that was published last
  // Declared last, because their threads use the members above.
  std::unique_ptr<PolicyPoller> poller_;
  std::vector<std::unique_ptr<Periodic>> periodic_;
};

absl::Status RunningServer::Begin(const std::vector<absl::Status>& refused) {
  StartLedger();
  if (membership_.is_shared()) {
    FollowReplicas();
    if (base_.registry->settings().has_joined()) base_.store.heads->WaitToJoin(kJoinTimeout);
  }
  RETURN_IF_ERROR(StartTransport());
  RETURN_IF_ERROR(StartHttp());
  if (certificates_.is_used()) certificates_.Start();
  if (options_.poll_policies > absl::ZeroDuration()) {
    poller_ = std::make_unique<PolicyPoller>(base_.registry.get(), options_.poll_policies, refused);
  }
  if (membership_.is_shared()) Every(kFollowInterval, [this] { FollowReplicas(); });
  Every(kRolloutInterval, [this] { operators_.rollouts.Tick(); });
  if (!options_.tokens.empty()) Every(kTokensInterval, [this] { ReloadTokens(); });
  return absl::OkStatus();
}

RunningServer::RunningServer(const ServerOptions& options, Foundation base)
    : options_(options),
      base_(std::move(base)),
      membership_(&base_),
      sessions_(options_, base_, &membership_, &clock_),
      operators_(options_, base_, &membership_, &sessions_, &clock_,
                 [this](bool) { PublishHealth(); }),
      grpc_(options_, base_, &sessions_, operators_, &clock_),
      http_({.authenticator = base_.authenticator.get(),
             .handler = &sessions_.handler,
             .admin = &operators_.handler,
             .store = &sessions_.store,
             .metrics = base_.metrics.get(),
             .history = &operators_.history,
             .clock = &clock_,
             .worker = &grpc_.worker,
             .serving = [this] { return serving() && TransportResponds(); },
             .store_address = base_.store.address,
             .replicas = membership_.replicas(),
             .reports = membership_.reports(),
             .unusual_deviations = options.unusual_deviations}) {}

absl::Status RunningServer::StartTransport() {
  RETURN_IF_ERROR(grpc_.Open(options_, &clock_));
  if (grpc_.tls != nullptr) certificates_.Add(grpc_.tls.get());
  Metrics& metrics = *base_.metrics;
  const PolicyRegistry& registry = *base_.registry;
  metrics.AddSource([this] { return CollectCertificates(certificates_); });
  metrics.AddSource([this] { return CollectRobots(sessions_.store); });
  metrics.AddSource([this] { return CollectSeats(sessions_.store); });
  if (!options_.datagram_listen.empty()) {
    metrics.AddSource([this] { return CollectDatagrams(sessions_.datagrams); });
  }
  metrics.AddSource([&registry] { return CollectTraffic(*registry.catalog()); });
  metrics.AddSource([&registry] { return CollectHeads(*registry.catalog()); });
  if (base_.store.heads != nullptr) {
    metrics.AddSource([heads = base_.store.heads.get()] { return CollectHeadLogs(*heads); });
  }
  metrics.AddSource([this] { return CollectConnections(*grpc_.transport); });
  sessions_.datagrams.SetEndpoint(options_.datagram_advertise.empty()
                                      ? grpc_.transport->datagram_address().ToString()
                                      : options_.datagram_advertise);
  PublishHealth();
  RETURN_IF_ERROR(grpc_.services.Attach(grpc_.transport.get()));
  Every(kTrimInterval, [this] { memory_.Trim(grpc_.transport->connections().counts().closed); });
  return grpc_.transport->Start();
}

void RunningServer::StartLedger() {
  sessions_.store.SetOnClosed([this](SessionEntry& entry) { sessions_.ledger.OnClosed(entry); });
  if (base_.journals != nullptr) {
    base_.journals->Keep(&sessions_.store, [this] { sessions_.ledger.BookEnds(); });
  }
  base_.metrics->AddSource([this] { return sessions_.ledger.Collect(); });
  sessions_.ledger.FollowMonth();  // so that what is spent is known before the first session
  Every(options_.usage.interval, [this] { sessions_.ledger.Tick(); });
}

bool RunningServer::TransportResponds() const {
  return grpc_.transport == nullptr || grpc_.transport->Responds(kHealthTimeout);
}

void RunningServer::PublishHealth() {
  grpc_.health.SetServing("", serving());
  grpc_.health.SetServing(MethodOf<v1::ListPoliciesRequest>().service, serving());
  grpc_.health.SetServing(MethodOf<inference::ServerLiveRequest>().service, serving());
  grpc_.health.SetServing(MethodOf<v1::LoadPolicyRequest>().service, !stopping_);
}

void RunningServer::FollowReplicas() {
  if (membership_.Follow()) sessions_.ledger.OnServerGone();
  if (grpc_.transport != nullptr && !joined_ && membership_.has_joined()) {
    joined_ = true;
    PublishHealth();
  }
}

void RunningServer::ReloadTokens() {
  if (auto status = base_.authenticator->Reload(); !status.ok()) {
    LogError("token file not reloaded; the old tokens stay valid", {{"error", status.message()}});
  }
}

absl::Status RunningServer::StartHttp() {
  RETURN_IF_ERROR(http_.Open(options_, base_, grpc_.transport.get(), &clock_));
  if (http_.server == nullptr) return absl::OkStatus();
  if (http_.tls != nullptr) certificates_.Add(http_.tls.get());
  Every(ServerHistory::kInterval, [this] { operators_.history.Tick(); });
  if (!membership_.is_shared()) return absl::OkStatus();
  Every(ServerHistory::kInterval, [this] {
    membership_.Report(ServerReport(operators_.history.Summary(),
                                    AddressForOthers(http_.server->address()), serving()),
                       clock_.Now());
  });
  return absl::OkStatus();
}

RunningServer::~RunningServer() { Stop(); }

void RunningServer::Stop() {
  if (stopping_.exchange(true)) return;
  poller_.reset();
  periodic_.clear();
  operators_.rollouts.SaveEvidence();
  // The others find out in any case.
  if (membership_.is_shared()) base_.store.shared->Leave().IgnoreError();
  if (grpc_.transport != nullptr) StopTransport();
  if (base_.journals != nullptr) base_.journals->Stop(absl::ZeroDuration());  // uses the sessions
  sessions_.ledger.BookAll();  // what the last answers have used
  http_.server.reset();
  if (base_.tracer != nullptr) base_.tracer->Stop();
  base_.metrics->KeepSeries();
}

void RunningServer::StopTransport() {
  // Before health turns NOT_SERVING: a client that sees it is not served any more.
  grpc_.gate.Drain();
  grpc_.transport->Drain();
  PublishHealth();
  absl::SleepFor(kDrainNotice);
  const absl::Duration end = clock_.Now() + options_.drain_timeout;
  while (grpc_.gate.calls() > 0 && clock_.Now() < end) absl::SleepFor(kDrainPollInterval);
  if (grpc_.gate.calls() > 0) {
    LogWarning("calls were still in flight after the drain timeout",
               {{"drain_timeout", absl::FormatDuration(options_.drain_timeout)}});
  }
  grpc_.health.EndWatches();
  grpc_.transport->Stop(kLeaveTimeout);
  if (base_.journals == nullptr) return;
  sessions_.Release();
  const bool reachable = base_.journals->CheckReachable().ok();
  base_.journals->Stop(reachable ? std::max(kLeaveTimeout, end - clock_.Now()) : kLeaveTimeout);
  if (base_.store.heads != nullptr) base_.store.heads->Stop(kLeaveTimeout);
  sessions_.recovery->ForgetWaiters();
}

}  // namespace

absl::StatusOr<std::unique_ptr<Server>> Server::Start(const ServerOptions& options) {
  RETURN_IF_ERROR(options.Validate());
  ReloadReport report;
  ASSIGN_OR_RETURN(auto base, Foundation::Open(options, &report));
  auto server = std::make_unique<RunningServer>(options, std::move(base));
  RETURN_IF_ERROR(server->Begin(report.refused));
  return server;
}

}  // namespace spikeserve
