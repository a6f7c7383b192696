#include "client/src/replicas.h"

#include <algorithm>
#include <random>
#include <utility>

#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "absl/time/clock.h"
#include "client/src/steady_time.h"
#include "spikeserve/retry.h"
#include "spikeserve/status.h"

namespace spikeserve {
namespace {

// How long AwaitConnection waits for the other servers after the first one is connected.
constexpr absl::Duration kConnectGrace = absl::Milliseconds(250);

bool IsPending(grpc_connectivity_state state) {
  return state == GRPC_CHANNEL_IDLE || state == GRPC_CHANNEL_CONNECTING;
}

}  // namespace

Replica::Replica(std::string of_address, std::shared_ptr<grpc::Channel> channel, Connector connect)
    : address(std::move(of_address)), connection(std::move(channel), std::move(connect)) {}

std::string DrawId() {
  std::random_device random;
  std::string id;
  for (int i = 0; i < 4; ++i) absl::StrAppend(&id, absl::Hex(random(), absl::kZeroPad8));
  return id;
}

absl::StatusOr<std::vector<std::string>> ParseServers(absl::string_view servers) {
  std::vector<std::string> addresses;
  for (const absl::string_view address : absl::StrSplit(servers, ',')) {
    addresses.emplace_back(absl::StripAsciiWhitespace(address));
    if (addresses.back().empty()) {
      return absl::InvalidArgumentError(absl::StrCat(
          "server: expected HOST:PORT or unix:PATH, several separated by commas, received \"",
          servers, "\""));
    }
  }
  return addresses;
}

uint64_t Rank(absl::string_view key, absl::string_view address) {
  uint64_t value = 0xCBF29CE484222325;
  for (const char c : absl::StrCat(key, "@", address)) {
    value = (value ^ static_cast<uint8_t>(c)) * 0x100000001B3;
  }
  for (const uint64_t factor : {0xFF51AFD7ED558CCD, 0xC4CEB9FE1A85EC53}) {
    value = (value ^ (value >> 33)) * factor;
  }
  return value ^ (value >> 33);
}

Replicas::Replicas(std::vector<std::unique_ptr<Replica>> replicas, absl::Duration first_pause,
                   absl::Duration longest_pause)
    : all_(std::move(replicas)), first_pause_(first_pause), longest_pause_(longest_pause) {}

Replicas::~Replicas() {
  absl::MutexLock lock(&mutex_);
  for (const auto& replica : all_) {
    if (replica->probe != nullptr) replica->probe->context.TryCancel();
  }
  mutex_.Await(absl::Condition(
      +[](int* probes) { return *probes == 0; }, &probes_));
}

bool Replicas::AwaitConnection(absl::Duration timeout) {
  // gRPC takes times of day, which it converts at once.
  if (all_.size() == 1) {
    return all_.front()->connection.line()->channel->WaitForConnected(
        absl::ToChronoTime(absl::Now() + timeout));
  }
  absl::Duration until = SteadyNow() + timeout;
  while (true) {
    bool is_connected = false;
    std::optional<std::pair<Replica*, grpc_connectivity_state>> pending;
    for (const auto& replica : all_) {
      const auto state = replica->connection.line()->channel->GetState(/*try_to_connect=*/true);
      is_connected = is_connected || state == GRPC_CHANNEL_READY;
      if (IsPending(state)) pending = {replica.get(), state};
    }
    const absl::Duration now = SteadyNow();
    if (is_connected) until = std::min(until, now + kConnectGrace);
    if (now >= until || (is_connected && !pending.has_value())) break;
    const absl::Duration pause = std::min(until - now, absl::Milliseconds(10));
    if (pending.has_value()) {
      pending->first->connection.line()->channel->WaitForStateChange(
          pending->second, absl::ToChronoTime(absl::Now() + pause));
    } else {
      absl::SleepFor(pause);
    }
  }
  absl::MutexLock lock(&mutex_);
  bool is_connected = false;
  for (const auto& replica : all_) {
    const bool is_ready = replica->connection.line()->channel->GetState(
                              /*try_to_connect=*/true) == GRPC_CHANNEL_READY;
    if (!is_ready) SetAway(*replica);
    is_connected = is_connected || is_ready;
  }
  return is_connected;
}

Replica* Replicas::Choose(Route& route, const std::set<const Replica*>& tried) {
  if (all_.size() == 1) return all_.front().get();
  absl::MutexLock lock(&mutex_);
  if (route.is_pinned && route.replica != nullptr) return route.replica;
  if (route.ranked.empty()) {
    std::vector<std::pair<uint64_t, Replica*>> ranks;
    for (const auto& replica : all_) {
      ranks.emplace_back(Rank(route.key, replica->address), replica.get());
    }
    std::stable_sort(ranks.begin(), ranks.end(),
                     [](const auto& a, const auto& b) { return a.first > b.first; });
    for (const auto& [rank, replica] : ranks) route.ranked.push_back(replica);
  }
  ProbeThoseDue();
  Replica* const last = route.replica;
  if (route.has_stream && last != nullptr && !last->is_away && tried.count(last) == 0) return last;
  std::vector<Replica*> left;
  for (Replica* replica : route.ranked) {
    if (tried.count(replica) == 0) left.push_back(replica);
  }
  if (left.empty()) left = route.ranked;
  const auto present =
      std::find_if(left.begin(), left.end(), [](const Replica* r) { return !r->is_away; });
  return present == left.end() ? left.front() : *present;
}

bool Replicas::MayMove(const Route& route) {
  if (all_.size() == 1) return false;
  absl::MutexLock lock(&mutex_);
  return !route.is_pinned;
}

void Replicas::KeepWithStream(Route& route) {
  absl::MutexLock lock(&mutex_);
  route.has_stream = true;
}

void Replicas::Pin(Route& route, bool is_pinned) {
  absl::MutexLock lock(&mutex_);
  route.is_pinned = is_pinned;
}

Replica* Replicas::PinnedTo(const Route& route) {
  absl::MutexLock lock(&mutex_);
  return route.is_pinned && all_.size() > 1 ? route.replica : nullptr;
}

void Replicas::Failed(Replica& replica, std::optional<absl::Duration> silent_for) {
  if (all_.size() == 1) return;
  absl::MutexLock lock(&mutex_);
  if (silent_for.has_value() && *silent_for < kProbeTimeout) {
    StartProbe(replica);
  } else {
    SetAway(replica);
  }
}

void Replicas::Answered(Route& route, Replica& replica) {
  if (all_.size() == 1) return;
  absl::MutexLock lock(&mutex_);
  route.replica = &replica;
  replica.is_away = false;
  replica.pause = absl::ZeroDuration();
}

void Replicas::SetAway(Replica& replica) {
  replica.is_away = true;
  replica.pause = std::min(std::max(2 * replica.pause, first_pause_), longest_pause_);
  replica.probe_at = SteadyNow() + replica.pause;
}

void Replicas::ProbeThoseDue() {
  const bool any_away =
      std::any_of(all_.begin(), all_.end(), [](const auto& replica) { return replica->is_away; });
  if (!any_away) return;
  const absl::Duration now = SteadyNow();
  for (const auto& replica : all_) {
    if (replica->is_away && now >= replica->probe_at) StartProbe(*replica);
  }
}

void Replicas::StartProbe(Replica& replica) {
  if (replica.probe != nullptr) return;
  replica.probe = std::make_unique<Probe>();
  replica.probe->line = replica.connection.line();
  ++probes_;
  Probe& probe = *replica.probe;
  probe.context.set_deadline(absl::ToChronoTime(absl::Now() + kProbeTimeout));
  // gRPC calls back on another thread, so the mutex may be held here.
  probe.line->health->async()->Check(
      &probe.context, &probe.request, &probe.response,
      [this, &replica](const grpc::Status& status) { Probed(replica, status); });
}

void Replicas::Probed(Replica& replica, const grpc::Status& status) {
  absl::MutexLock lock(&mutex_);
  // A server without the health service counts as serving.
  const bool serves = status.ok() ? replica.probe->response.status() ==
                                        grpc::health::v1::HealthCheckResponse::SERVING
                                  : !IsRetryable(StatusFromGrpc(status));
  if (serves) {
    replica.is_away = false;
  } else {
    SetAway(replica);
  }
  replica.probe.reset();
  --probes_;
}

}  // namespace spikeserve
