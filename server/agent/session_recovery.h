// Takes over sessions that this server does not hold from the store: after a restart, or from
// another server. Also reads them there, without taking them over.
//
// Thread-safe.
#pragma once

#include <functional>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "core/base/clock.h"
#include "core/open_sessions/session_store.h"
#include "server/access/authenticator.h"
#include "server/agent/given_up_copies.h"
#include "server/followers/recordings.h"
#include "server/policies/policy_registry.h"
#include "server/store/journal_store.h"

namespace spikeserve {

// Returns true if `id` has the form of an id that NewSessionId() draws: 32 hexadecimal digits in
// lower case. Only such sessions are stored.
bool IsDrawnSessionId(absl::string_view id);

// Returns the name of a version's file: SessionJournal::Key::policy_file.
std::string PolicyFileOf(const ServedPolicy& served);

class SessionRecovery {
 public:
  // Runs work on the thread of the caller's event loop.
  using Post = std::function<void(std::function<void()>)>;
  using Done = std::function<void(const absl::Status&)>;
  using WhenRead = std::function<void(absl::StatusOr<std::shared_ptr<SessionEntry>>)>;

  // All must outlive the object; `recordings` may be null.
  SessionRecovery(JournalStore* journals, const PolicyRegistry* registry, SessionStore* sessions,
                  Recordings* recordings)
      : journals_(*journals), registry_(*registry), sessions_(*sessions), recordings_(recordings) {}

  // Claims session `id` of the caller's tenant, restores it and adds it to the sessions of this
  // server. Calls `done` by `post`: with OK if the server holds the session now, NOT_FOUND if the
  // store has no such session, UNAVAILABLE if the store cannot be reached, has lost a session of
  // which this server had a copy a moment ago (GivenUpCopies), or this server does not have the
  // session's policy, which then stays with its owner, DATA_LOSS if its journal is damaged, or an
  // error of SessionStore::Restore().
  void Recover(const Credential& caller, const std::string& id, const Post& post, Done done)
      ABSL_LOCKS_EXCLUDED(mutex_);

  // Reads session `id` of the caller's tenant as the store has it. It stays with its owner, which
  // may have decided since. Calls `done` by `post`. Errors: as Recover().
  void Read(const Credential& caller, const std::string& id, const Post& post, WhenRead done);

  // Returns whether other servers may own sessions of the store.
  bool is_shared() const { return journals_.IsShared(); }

  // Forgets the callers that still wait. For the end of the server, when the event loops have
  // stopped and `done` would not be called any more.
  void ForgetWaiters() ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  using Key = GivenUpCopies::Key;
  struct Waiter {
    Post post;
    Done done;
  };

  // What a journal says.
  struct Restored {
    std::shared_ptr<const ServedPolicy> served;
    Session session;
    size_t entries = 0;    // that were folded into the session
    size_t after_gap = 0;  // records that were left out
    absl::Status cut;      // why records at the end were left out
  };
  absl::StatusOr<Restored> Unfold(const Key& key, ClaimedJournal* claimed) const;

  JournalClaim ClaimOf(const Key& key) const;
  absl::Status Restore(const Key& key, std::shared_ptr<SessionQuota> quota,
                       absl::StatusOr<ClaimedJournal> claimed);
  // Goes on with the copy that this server had given up, because the store has lost the session.
  absl::Status TakeBack(const Key& key, std::shared_ptr<SessionQuota> quota);
  absl::Status Add(std::shared_ptr<const ServedPolicy> served, Session session,
                   SessionExtras extras);
  void Finish(const Key& key, const absl::Status& status) ABSL_LOCKS_EXCLUDED(mutex_);

  JournalStore& journals_;
  const PolicyRegistry& registry_;
  SessionStore& sessions_;
  Recordings* const recordings_;
  const SteadyClock clock_;
  GivenUpCopies former_{&clock_};

  absl::Mutex mutex_;
  std::map<Key, std::vector<Waiter>> claims_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
