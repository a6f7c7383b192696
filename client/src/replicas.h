// The servers of a client, and which of them a call goes to.
//
// Servers that keep their sessions in one store are replicas: each of them can continue with every
// session. The calls of a session go to the same replica while it answers, because a session that
// moves costs a claim.
#pragma once

#include <grpcpp/channel.h>
#include <grpcpp/client_context.h>

#include <cstdint>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "client/src/connection.h"
#include "grpc/health/v1/health.grpc.pb.h"

namespace spikeserve {

// The metadata by which proxies choose a server.
inline constexpr char kAffinityKey[] = "spikeserve-affinity";

// How long a server may take to say that it serves. A call that had no answer for this time shows
// that the server cannot be reached.
inline constexpr absl::Duration kProbeTimeout = absl::Seconds(1);

// A health check that is under way.
struct Probe {
  std::shared_ptr<Line> line;
  grpc::ClientContext context;
  grpc::health::v1::HealthCheckRequest request;
  grpc::health::v1::HealthCheckResponse response;
};

// One server of a client.
struct Replica {
  // Without `connect`, the connection is never replaced by a fresh one.
  Replica(std::string of_address, std::shared_ptr<grpc::Channel> channel, Connector connect);

  const std::string address;
  RenewableConnection connection;

  // The rest is guarded by the mutex of Replicas.
  bool is_away = false;
  std::unique_ptr<Probe> probe;                         // null: none is under way
  absl::Duration probe_at = -absl::InfiniteDuration();  // of SteadyNow()
  absl::Duration pause;  // between the last failure and the next probe
};

// What decides the server of calls that belong together: of a session, a stream or a batch.
//
// `key` is the affinity metadata. It ranks the servers, equally in every client. A pinned route
// stays at the server that answered last: sessions that no store has exist there only. That of a
// stream stays there while the server can be reached: the stream does not return to the server that
// it prefers, and a call beside it that did would take a session from it.
struct Route {
  explicit Route(std::string of_key) : key(std::move(of_key)) {}

  const std::string key;
  // The rest is guarded by the mutex of Replicas.
  bool is_pinned = false;
  bool has_stream = false;
  Replica* replica = nullptr;  // the one that answered last
  std::vector<Replica*> ranked;
};

// Returns a random session id or key: 32 hexadecimal digits.
std::string DrawId();

// Splits a list of addresses that is separated by commas. Returns INVALID_ARGUMENT if one is empty.
absl::StatusOr<std::vector<std::string>> ParseServers(absl::string_view servers);

// Returns the rank of a server for a key: rendezvous hashing with FNV-1a and a final mix. The
// Python client computes the same number, so that all clients of a session prefer one server.
uint64_t Rank(absl::string_view key, absl::string_view address);

// The replicas of a client, and which of them cannot be reached. Thread-safe.
//
// A replica that failed gets no calls until a health check has found it again, if there is another
// one. The pauses before checks double from `first_pause` to `longest_pause`.
class Replicas {
 public:
  // REQUIRES: at least one replica.
  Replicas(std::vector<std::unique_ptr<Replica>> replicas, absl::Duration first_pause,
           absl::Duration longest_pause);
  // Cancels the health checks and blocks until they have ended.
  ~Replicas();

  size_t size() const { return all_.size(); }

  // Waits until a server is connected and the others are, too, or have failed, or some time has
  // passed. Servers that are not connected then count as away. Returns whether one is connected.
  bool AwaitConnection(absl::Duration timeout) ABSL_LOCKS_EXCLUDED(mutex_);

  // Calls `visit` with each replica, in the order of the addresses.
  template <typename Visit>
  void ForEach(Visit visit) const {
    for (const auto& replica : all_) visit(*replica);
  }

  // Returns the preferred replica of a route that is not away and not among `tried`. Returns one
  // that is away if no other is left, and one that was tried if all were.
  Replica* Choose(Route& route, const std::set<const Replica*>& tried = {})
      ABSL_LOCKS_EXCLUDED(mutex_);

  // Returns whether a call of the route may go to another replica.
  bool MayMove(const Route& route) ABSL_LOCKS_EXCLUDED(mutex_);
  // A stream takes the route, so that the calls beside it stay at its server.
  void KeepWithStream(Route& route) ABSL_LOCKS_EXCLUDED(mutex_);
  // Pins a route to the replica that answered last, or lets it move.
  void Pin(Route& route, bool is_pinned) ABSL_LOCKS_EXCLUDED(mutex_);
  // Returns the replica that a route is pinned to, or null if it may move or there is no other.
  Replica* PinnedTo(const Route& route) ABSL_LOCKS_EXCLUDED(mutex_);

  // Notes that a call failed because of its replica. `silent_for` is how long the call waited in
  // vain; absent: it was refused, or the connection broke. A short silence only leads to a check.
  void Failed(Replica& replica, std::optional<absl::Duration> silent_for = std::nullopt)
      ABSL_LOCKS_EXCLUDED(mutex_);
  // Notes that a replica answered a call.
  void Answered(Route& route, Replica& replica) ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  void SetAway(Replica& replica) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void ProbeThoseDue() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void StartProbe(Replica& replica) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Notes the end of a health check, on a thread of gRPC.
  void Probed(Replica& replica, const grpc::Status& status) ABSL_LOCKS_EXCLUDED(mutex_);

  const std::vector<std::unique_ptr<Replica>> all_;
  const absl::Duration first_pause_;
  const absl::Duration longest_pause_;
  absl::Mutex mutex_;
  int probes_ ABSL_GUARDED_BY(mutex_) = 0;  // under way
};

}  // namespace spikeserve
