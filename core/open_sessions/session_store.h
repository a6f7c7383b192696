// Stores the open sessions of a server by id. Sessions of different tenants may have equal ids.
//
// Thread-safe. Ids are distributed over shards, each with a mutex that is held only for a lookup. A
// decision holds only the mutex of its session. Lock order: a thread that takes a session's mutex
// holds no mutex of the store.
#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/container/flat_hash_map.h"
#include "absl/functional/function_ref.h"
#include "absl/hash/hash.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/agent/episode_recorder.h"
#include "core/agent/served_policy.h"
#include "core/agent/shadow_session.h"
#include "core/base/clock.h"
#include "core/journal/session_journal.h"
#include "core/open_sessions/closed_sessions.h"
#include "core/open_sessions/session_entry.h"
#include "core/open_sessions/session_quota.h"

namespace spikeserve {

// Optional properties of a new session, beside its policy and options.
struct SessionExtras {
  std::string id;                         // from NewSessionId(); empty: created by Open
  std::shared_ptr<ShadowSession> shadow;  // null: none
  std::shared_ptr<SessionQuota> quota;    // quota that the session counts against; null: none
  std::shared_ptr<EpisodeRecorder> recorder = nullptr;  // null: none
  std::shared_ptr<SessionJournal> journal = nullptr;    // null: the session is not stored
  bool assigned = false;  // a roll-out has chosen the version of the session
};

// Returns whether the robot of a session with this period is silent, if it has sent nothing for
// `idle`: neither a late beat nor a short pause counts.
inline bool IsSilent(absl::Duration period, absl::Duration idle) {
  return period > absl::ZeroDuration() && idle > 50 * period && idle > absl::Seconds(2);
}

// One element of the result of SessionStore::List.
struct ListedSession {
  std::string id;
  std::shared_ptr<SessionEntry> entry;
  absl::Duration idle;  // since the last Find
};

// A sharded map from ids to sessions.
class SessionStore {
 public:
  // `clock` must outlive the store and every entry.
  SessionStore(int64_t max_sessions, const Clock* clock);

  // Returns the clock of its sessions.
  const Clock* clock() const { return clock_; }

  // Opens a session and returns its id. RESOURCE_EXHAUSTED if max_sessions are open or the quota is
  // used up; ALREADY_EXISTS if the tenant has an open session with the id of `extras`; UNAVAILABLE
  // while draining.
  absl::StatusOr<std::string> Open(std::shared_ptr<const ServedPolicy> served,
                                   SessionOptions options, SessionExtras extras = {});

  // Adds a session that was restored from its journal. Errors as for Open.
  absl::Status Restore(std::shared_ptr<const ServedPolicy> served, Session session,
                       SessionExtras extras);

  // Calls `on_closed` for each session that has left the store, before its journal ends, and from
  // time to time while its episodes wait for verdicts. To be called once, before sessions are
  // opened.
  void SetOnClosed(std::function<void(SessionEntry&)> on_closed) {
    on_closed_ = std::move(on_closed);
  }

  // Refuses new sessions while `draining`. Open sessions continue.
  void SetDraining(bool draining) { draining_.store(draining, std::memory_order_relaxed); }
  bool draining() const { return draining_.load(std::memory_order_relaxed); }

  // Looks up a session of `tenant` and resets its idle timer. NOT_FOUND if the tenant has no
  // session with this id. Removes a session whose journal is lost to another owner.
  absl::StatusOr<std::shared_ptr<SessionEntry>> Find(absl::string_view id,
                                                     absl::string_view tenant = "");

  // Looks up the session of `tenant`, or otherwise of any other tenant, without resetting its idle
  // timer. Returns null if the id is unknown.
  std::shared_ptr<SessionEntry> Peek(absl::string_view id, absl::string_view tenant = "");

  // As Peek, with the session's idle time. Returns nullopt if the id is unknown.
  std::optional<ListedSession> PeekListed(absl::string_view id, absl::string_view tenant = "");

  // The sessions that have left while episodes waited for verdicts.
  ClosedSessions& closed() { return closed_; }

  // Removes a session of `tenant`. NOT_FOUND if the tenant has no session with this id.
  absl::Status Close(absl::string_view id, absl::string_view tenant = "");

  // The methods below do not reset idle timers. `wanted` is called under a lock of the store: it
  // must be quick and must not take a session's lock.

  // Returns, sorted by id, the first `limit` sessions after the id `after` for which `wanted`
  // returns true. Needs memory for these only.
  std::vector<ListedSession> ListAfter(absl::string_view after, size_t limit,
                                       absl::FunctionRef<bool(const SessionEntry&)> wanted);

  // Calls `visit` for every open session for which `wanted` returns true, in no order. `visit` may
  // take the session's lock. Needs memory for one shard.
  void ForEach(absl::FunctionRef<bool(const SessionEntry&)> wanted,
               absl::FunctionRef<void(const ListedSession&)> visit);

  // Returns all open sessions for which `wanted` returns true, sorted by id.
  std::vector<ListedSession> List(absl::FunctionRef<bool(const SessionEntry&)> wanted);

  // Does not count `time`, in which the process did not run, as idle time of the sessions.
  void Forgive(absl::Duration time);

  // Removes every session that no request holds and that was not used for `time_to_live`. Returns
  // how many.
  int64_t RemoveIdle(absl::Duration time_to_live);

  // Compacts every session that no request holds and that was not used for `idle_for`, once until
  // it is used again. Returns how many. Does not change the sessions' answers.
  int64_t CompactIdle(absl::Duration idle_for);

  // Returns the number of open sessions.
  int64_t size() const { return size_.load(std::memory_order_relaxed) - closed_.size(); }

 private:
  struct Slot {
    std::shared_ptr<SessionEntry> entry;
    absl::Duration last_used;  // time of the clock
    bool compacted = false;    // since `last_used`
  };
  struct Name {
    std::string id;
    const std::string* tenant;  // of the entry of this name
  };
  struct NameView {
    absl::string_view id;
    std::optional<absl::string_view> tenant;  // absent: any
  };
  struct NameHash {
    using is_transparent = void;
    size_t operator()(const Name& name) const { return absl::HashOf(name.id); }
    size_t operator()(const NameView& name) const { return absl::HashOf(name.id); }
  };
  struct NameEq {
    using is_transparent = void;
    bool operator()(const Name& a, const NameView& b) const {
      return a.id == b.id && (!b.tenant.has_value() || *a.tenant == *b.tenant);
    }
    bool operator()(const Name& a, const Name& b) const {
      return (*this)(a, NameView{b.id, *b.tenant});
    }
  };
  using Slots = absl::flat_hash_map<Name, Slot, NameHash, NameEq>;
  struct Shard {
    absl::Mutex mutex;
    Slots slots ABSL_GUARDED_BY(mutex);
  };
  static constexpr size_t kShards = 64;

  Shard& ShardOf(absl::string_view id);
  // Adds `session`. If `is_new`, its journal starts with it.
  absl::Status Add(std::shared_ptr<const ServedPolicy> served, Session session,
                   SessionExtras extras, bool is_new);
  // Returns the session that Peek() finds, or the end of the slots.
  static Slots::iterator Look(Shard& shard, absl::string_view id, absl::string_view tenant)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(shard.mutex);
  // Tells the observer and the ledger that session `id` has left the store, and forgets it unless
  // its episodes wait for verdicts.
  void NotifyClosed(const std::string& id, const std::shared_ptr<SessionEntry>& entry);
  // Makes room for another session, and ends the journal of this one.
  void Forget(const SessionEntry& entry);
  // Returns false if its tenant has an open session with this id.
  bool Insert(const std::string& id, std::shared_ptr<SessionEntry> entry);

  const int64_t max_sessions_;
  const Clock* const clock_;
  std::function<void(SessionEntry&)> on_closed_;  // null: none
  std::atomic<int64_t> size_ = 0;                 // with those of `closed_`
  std::atomic<bool> draining_ = false;
  std::array<Shard, kShards> shards_;
  ClosedSessions closed_;
};

}  // namespace spikeserve
