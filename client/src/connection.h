// The connection to one server: a line, which a fresh one replaces if it does not answer.
//
// A NAT, a firewall or a mobile network may forget a connection and drop its packets without a
// word, while new connections work. The keepalive of HTTP/2 finds that out after seconds. Therefore
// a fresh line is tried as soon as answers are missing: both get a health check, and if the fresh
// line answers first, it takes the place of the old one, and the calls on the old one are
// cancelled.
//
// Thread-safe.
#pragma once

#include <grpcpp/channel.h>
#include <grpcpp/client_context.h>

#include <condition_variable>
#include <functional>
#include <memory>
#include <thread>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/container/flat_hash_set.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "grpc/health/v1/health.grpc.pb.h"
#include "spikeserve/v1/policy_service.grpc.pb.h"

namespace spikeserve {

// A channel with the services on it.
struct Line {
  explicit Line(std::shared_ptr<grpc::Channel> to);

  const std::shared_ptr<grpc::Channel> channel;
  const std::unique_ptr<v1::PolicyService::Stub> stub;
  const std::unique_ptr<grpc::health::v1::Health::Stub> health;
};

// Returns a new channel to the server, or null.
using Connector = std::function<std::shared_ptr<grpc::Channel>()>;

// How long calls may wait without any answer, and how many may miss their deadline in a row, before
// a fresh line is tried.
inline constexpr absl::Duration kLineSilence = absl::Milliseconds(300);
inline constexpr int kLineMisses = 3;

class RenewableConnection {
 public:
  // A call under way, from its begin to its end. Not thread-safe.
  class Watched {
   public:
    // `context` is cancelled if a fresh line replaces that of the call. If `expects_answer`, a call
    // that lasts for kLineSilence puts the line in doubt; streams are silent for other reasons.
    Watched(RenewableConnection* connection, grpc::ClientContext* context, bool expects_answer);
    ~Watched();
    Watched(const Watched&) = delete;
    Watched& operator=(const Watched&) = delete;

    Line& line() const { return *line_; }
    // Notes the end of the call. Returns `status`, or UNAVAILABLE if the call was cancelled because
    // of a fresh line.
    absl::Status Note(const absl::Status& status) const;

   private:
    friend class RenewableConnection;

    RenewableConnection* const connection_;
    grpc::ClientContext* const context_;
    const absl::Duration began_;  // of SteadyNow()
    const bool expects_answer_;
    std::shared_ptr<Line> line_;
  };

  // Without `connect`, the line is never replaced.
  RenewableConnection(std::shared_ptr<grpc::Channel> channel, Connector connect);
  // REQUIRES: no call is watched. Blocks until a race has ended, for a second at most.
  ~RenewableConnection();

  // Returns the line for a call that begins now.
  std::shared_ptr<Line> line() ABSL_LOCKS_EXCLUDED(mutex_);

  // Notes an answer of the server, of whatever kind.
  void Answered() ABSL_LOCKS_EXCLUDED(mutex_);
  // Notes a call that began at `began`, of SteadyNow(), and had no answer in time.
  void Missed(absl::Duration began) ABSL_LOCKS_EXCLUDED(mutex_);
  // Tries a fresh line if there was no answer since `since`, of SteadyNow(), for kLineSilence.
  void Doubt(absl::Duration since) ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  void WakeWatch() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  struct Work {
    std::vector<std::shared_ptr<Line>> ended = {};  // to be destroyed
    bool races = false;
  };

  // Runs on a thread from the first call on, and waits while no calls are watched.
  void Watch() ABSL_LOCKS_EXCLUDED(mutex_);
  Work TakeWork() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Waits for a tick, or until there are calls again.
  void Wait() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  bool IsDoubtful(absl::Duration now) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void Race() ABSL_LOCKS_EXCLUDED(mutex_);

  const Connector connect_;
  absl::Mutex mutex_;
  std::condition_variable_any changed_;
  std::shared_ptr<Line> line_ ABSL_GUARDED_BY(mutex_);
  // Lines that were replaced. A channel must not be destroyed on a thread of gRPC, so the watch
  // destroys them when their last call has ended.
  std::vector<std::shared_ptr<Line>> retired_ ABSL_GUARDED_BY(mutex_);
  absl::flat_hash_set<Watched*> calls_ ABSL_GUARDED_BY(mutex_);
  absl::Duration answered_at_ ABSL_GUARDED_BY(mutex_) = -absl::InfiniteDuration();
  absl::Duration silent_since_ ABSL_GUARDED_BY(mutex_) = absl::InfiniteDuration();
  absl::Duration busy_at_ ABSL_GUARDED_BY(mutex_) = -absl::InfiniteDuration();
  absl::Duration next_race_ ABSL_GUARDED_BY(mutex_) = -absl::InfiniteDuration();
  absl::Duration pause_ ABSL_GUARDED_BY(mutex_);
  int misses_ ABSL_GUARDED_BY(mutex_) = 0;          // in a row
  bool is_asked_ ABSL_GUARDED_BY(mutex_) = false;   // to try a fresh line
  bool is_parked_ ABSL_GUARDED_BY(mutex_) = false;  // the watch waits without a timeout
  bool is_stopping_ ABSL_GUARDED_BY(mutex_) = false;
  std::thread watch_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
