#include "server/server.h"

#include <unistd.h>

#include <algorithm>

#include "absl/time/clock.h"
#include "absl/time/time.h"
#include "core/base/status_macros.h"
#include "server/base/log.h"
#include "server/gauges.h"
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

}  // namespace

absl::StatusOr<std::unique_ptr<Server>> Server::Start(const ServerOptions& options) {
  RETURN_IF_ERROR(options.Validate());
  ReloadReport report;
  ASSIGN_OR_RETURN(auto base, Foundation::Open(options, &report));
  auto server = std::unique_ptr<Server>(new Server(options, std::move(base)));
  Server* const started = server.get();
  started->StartLedger();
  if (started->membership_.is_shared()) {
    started->FollowReplicas();
    if (started->base_.registry->settings().has_joined()) {
      started->base_.store.heads->WaitToJoin(kJoinTimeout);
    }
  }
  RETURN_IF_ERROR(started->StartTransport());
  RETURN_IF_ERROR(started->StartHttp());
  if (started->certificates_.is_used()) started->certificates_.Start();
  if (options.poll_policies > absl::ZeroDuration()) {
    started->poller_ = std::make_unique<PolicyPoller>(started->base_.registry.get(),
                                                      options.poll_policies, report.refused);
  }
  if (started->membership_.is_shared()) {
    started->Every(kFollowInterval, [started] { started->FollowReplicas(); });
  }
  started->Every(kRolloutInterval, [started] { started->operators_.rollouts.Tick(); });
  if (!options.tokens.empty()) {
    started->Every(kTokensInterval, [started] { started->ReloadTokens(); });
  }
  return server;
}

Server::Server(const ServerOptions& options, Foundation base)
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

absl::Status Server::StartTransport() {
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
  metrics.AddSource([this] { return CollectConnections(*grpc_.transport); });
  sessions_.datagrams.SetEndpoint(options_.datagram_advertise.empty()
                                      ? grpc_.transport->datagram_address().ToString()
                                      : options_.datagram_advertise);
  PublishHealth();
  RETURN_IF_ERROR(grpc_.services.Attach(grpc_.transport.get()));
  Every(kTrimInterval, [this] { memory_.Trim(grpc_.transport->connections().counts().closed); });
  return grpc_.transport->Start();
}

void Server::StartLedger() {
  sessions_.store.SetOnClosed([this](SessionEntry& entry) { sessions_.ledger.OnClosed(entry); });
  if (base_.journals != nullptr) {
    base_.journals->Keep(&sessions_.store, [this] { sessions_.ledger.BookEnds(); });
  }
  base_.metrics->AddSource([this] { return sessions_.ledger.Collect(); });
  sessions_.ledger.FollowMonth();  // so that what is spent is known before the first session
  Every(options_.usage.interval, [this] { sessions_.ledger.Tick(); });
}

bool Server::TransportResponds() const {
  return grpc_.transport == nullptr || grpc_.transport->Responds(kHealthTimeout);
}

void Server::PublishHealth() {
  grpc_.health.SetServing("", serving());
  grpc_.health.SetServing(MethodOf<v1::ListPoliciesRequest>().service, serving());
  grpc_.health.SetServing(MethodOf<inference::ServerLiveRequest>().service, serving());
  grpc_.health.SetServing(MethodOf<v1::LoadPolicyRequest>().service, !stopping_);
}

void Server::FollowReplicas() {
  if (membership_.Follow()) sessions_.ledger.OnServerGone();
  if (grpc_.transport != nullptr && !joined_ && membership_.has_joined()) {
    joined_ = true;
    PublishHealth();
  }
}

void Server::ReloadTokens() {
  if (auto status = base_.authenticator->Reload(); !status.ok()) {
    LogError("token file not reloaded; the old tokens stay valid", {{"error", status.message()}});
  }
}

absl::Status Server::StartHttp() {
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

Server::~Server() { Stop(); }

void Server::Stop() {
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

void Server::StopTransport() {
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

}  // namespace spikeserve
