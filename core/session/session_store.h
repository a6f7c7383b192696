// The live sessions of a server, by id.
//
// Thread-safe. Ids are spread over shards, each with a mutex that is held for a lookup only; a
// decision holds the mutex of its own session and no other. Lock order: no mutex of the store is
// ever held while a session's is taken.
#ifndef CORE_SESSION_SESSION_STORE_H_
#define CORE_SESSION_SESSION_STORE_H_

#include <array>
#include <atomic>
#include <cstdint>
#include <memory>
#include <string>

#include "absl/base/thread_annotations.h"
#include "absl/container/flat_hash_map.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/session/agent_session.h"
#include "core/session/clock.h"
#include "core/session/served_policy.h"

namespace spikeserve {

// A session with the lock that lets one request at a time use it. Outlives its place in the store
// for as long as a request holds on to it.
struct SessionEntry {
  SessionEntry(std::shared_ptr<const ServedPolicy> policy, Session session, const Clock* clock)
      : served(policy), agent(std::move(policy), std::move(session), clock) {}

  const std::shared_ptr<const ServedPolicy> served;
  absl::Mutex mutex;
  AgentSession agent ABSL_GUARDED_BY(mutex);
};

class SessionStore {
 public:
  // `clock` must outlive the store and every entry.
  SessionStore(int64_t max_sessions, const Clock* clock);

  // Opens a session under `id`, or, where that is empty, a new random one of 128 bits in
  // hexadecimal; returns the id. RESOURCE_EXHAUSTED where max_sessions are open; ALREADY_EXISTS
  // where one of this id is.
  absl::StatusOr<std::string> Open(std::shared_ptr<const ServedPolicy> served,
                                   SessionOptions options, std::string id = "");

  // The session, marked as used now. NOT_FOUND where there is none of this id.
  absl::StatusOr<std::shared_ptr<SessionEntry>> Find(absl::string_view id);

  // Takes the session out. NOT_FOUND where there is none of this id.
  absl::Status Close(absl::string_view id);

  // Takes out every session that nobody holds and nobody has used for `time_to_live`; returns how
  // many.
  int64_t RemoveIdle(absl::Duration time_to_live);

  int64_t size() const { return size_.load(std::memory_order_relaxed); }

 private:
  struct Slot {
    std::shared_ptr<SessionEntry> entry;
    absl::Duration last_used;  // on the clock
  };
  struct Shard {
    absl::Mutex mutex;
    absl::flat_hash_map<std::string, Slot> slots ABSL_GUARDED_BY(mutex);
  };
  static constexpr size_t kShards = 64;

  Shard& ShardOf(absl::string_view id);

  const int64_t max_sessions_;
  const Clock* const clock_;
  std::atomic<int64_t> size_ = 0;
  std::array<Shard, kShards> shards_;
};

}  // namespace spikeserve

#endif  // CORE_SESSION_SESSION_STORE_H_
