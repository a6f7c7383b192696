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
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/container/flat_hash_map.h"
#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "core/session/agent_session.h"
#include "core/session/served_policy.h"
#include "core/session/session_quota.h"
#include "core/session/shadow_session.h"

namespace spikeserve {

// A session with the lock that lets one request at a time use it. Outlives its place in the store
// for as long as a request holds on to it.
struct SessionEntry {
  SessionEntry(std::shared_ptr<const ServedPolicy> policy, Session session, const Clock* clock)
      : served(policy),
        tenant(session.options.tenant),
        agent(std::move(policy), std::move(session), clock) {}

  const std::shared_ptr<const ServedPolicy> served;
  const std::string tenant;  // whose it is
  // Null: none. Set before anyone else sees the entry.
  std::shared_ptr<ShadowSession> shadow;
  std::shared_ptr<SessionQuota> quota;
  absl::Mutex mutex;
  AgentSession agent ABSL_GUARDED_BY(mutex);
  std::vector<ShadowStep> shadow_steps ABSL_GUARDED_BY(mutex);  // that the shadow is still to see
};

// What a session may be opened with, beside its policy and options.
struct SessionExtras {
  std::string id;                                       // from NewSessionId(); empty: a new one
  std::shared_ptr<ShadowSession> shadow;                // null: none
  std::shared_ptr<SessionQuota> quota;                  // that it counts against; null: none
  std::unique_ptr<EpisodeRecorder> recorder = nullptr;  // null: none
};

// NOT_FOUND: nobody the caller may know of has this id.
absl::Status NoSuchSession(absl::string_view id);

// 128 random bits in hexadecimal, from the kernel, so that nobody can guess another agent's
// session.
absl::StatusOr<std::string> NewSessionId();

// One line of SessionStore::List.
struct ListedSession {
  std::string id;
  std::shared_ptr<SessionEntry> entry;
  absl::Duration idle;  // since the last Find
};

class SessionStore {
 public:
  // `clock` must outlive the store and every entry.
  SessionStore(int64_t max_sessions, const Clock* clock);

  // Opens a session and returns its id. RESOURCE_EXHAUSTED where max_sessions are open or the quota
  // is used up; ALREADY_EXISTS where one of its id is open; UNAVAILABLE while draining.
  absl::StatusOr<std::string> Open(std::shared_ptr<const ServedPolicy> served,
                                   SessionOptions options, SessionExtras extras = {});

  // Whether sessions can be opened; those that are open go on either way.
  void SetDraining(bool draining) { draining_.store(draining, std::memory_order_relaxed); }
  bool draining() const { return draining_.load(std::memory_order_relaxed); }

  // The session, marked as used now. NOT_FOUND where `tenant` has none of this id.
  absl::StatusOr<std::shared_ptr<SessionEntry>> Find(absl::string_view id,
                                                     absl::string_view tenant = "");

  // The session, whoever's it is, without counting as a use; null where there is none of this id.
  std::shared_ptr<SessionEntry> Peek(absl::string_view id);

  // Takes the session out. NOT_FOUND where `tenant` has none of this id.
  absl::Status Close(absl::string_view id, absl::string_view tenant = "");

  // The open sessions that `wanted` says yes to, by id. Leaves when they were used last as it is.
  // `wanted` is called under a lock, must be quick, and leaves the session's own lock alone.
  std::vector<ListedSession> List(absl::FunctionRef<bool(const SessionEntry&)> wanted);

  // Takes out every session that nobody holds and nobody has used for `time_to_live`; returns how
  // many.
  int64_t RemoveIdle(absl::Duration time_to_live);

  // Compacts every session that nobody holds and nobody has used for `idle_for`, once until it is
  // used again; returns how many. It goes on bit for bit as it would have.
  int64_t CompactIdle(absl::Duration idle_for);

  int64_t size() const { return size_.load(std::memory_order_relaxed); }

 private:
  struct Slot {
    std::shared_ptr<SessionEntry> entry;
    absl::Duration last_used;  // on the clock
    bool compacted = false;    // since then
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
  std::atomic<bool> draining_ = false;
  std::array<Shard, kShards> shards_;
};

}  // namespace spikeserve

#endif  // CORE_SESSION_SESSION_STORE_H_
