// Keeps the copies of sessions that this server has given up because a request was ahead of them,
// until the store has shown that it has the session.
//
// A Redis that evicts keys, or comes back empty, may have nothing of a session when its former
// owner asks. Then the given-up copy may be the last one. Another server may still have a newer
// one, and writes it again when it is asked or compares its journals next. So the copy waits for a
// while, in which the caller is sent elsewhere, and is taken back only then.
//
// Thread-safe.
#pragma once

#include <cstddef>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "core/open_sessions/session_store.h"
#include "core/session/session_id.h"
#include "server/base/retry_delay.h"

namespace spikeserve {

class GivenUpCopies {
 public:
  using Key = std::pair<std::string, std::string>;  // tenant and session

  // How long callers are sent elsewhere, from the first one for whom the store had nothing, before
  // a copy is taken back.
  static constexpr absl::Duration kWait = absl::Seconds(3);
  // How long a copy is kept for callers that do not come again, and how many.
  static constexpr absl::Duration kKept = absl::Minutes(5);
  static constexpr size_t kMost = 10'000;

  // `clock` must outlive the object.
  explicit GivenUpCopies(const Clock* clock) : clock_(*clock) {}

  // Keeps `entry`, which this server has given up.
  void Keep(const Key& key, const std::shared_ptr<SessionEntry>& entry)
      ABSL_LOCKS_EXCLUDED(mutex_) {
    const absl::Duration now = clock_.Now();
    absl::MutexLock lock(&mutex_);
    if (copies_.size() >= kMost) Prune(now);
    if (copies_.size() < kMost) copies_.try_emplace(key, Copy{.entry = entry, .since = now});
  }

  // The store has the session, or says that it has ended. Returns the copy, which is kept no more,
  // or null.
  std::shared_ptr<SessionEntry> Take(const Key& key) ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    const auto found = copies_.find(key);
    if (found == copies_.end()) return nullptr;
    std::shared_ptr<SessionEntry> entry = std::move(found->second.entry);
    copies_.erase(found);
    return entry;
  }

  // Restarts the wait after a store error: other owners also need time to rewrite their
  // sessions.
  void WaitAgain(const Key& key) ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    if (const auto found = copies_.find(key); found != copies_.end()) found->second.lost.reset();
  }

  // The store has lost the session. Returns the copy, which is kept no more, if the callers have
  // waited long enough; UNAVAILABLE if they are to try again, perhaps elsewhere; NOT_FOUND if there
  // is none.
  absl::StatusOr<std::shared_ptr<SessionEntry>> TakeBack(const Key& key)
      ABSL_LOCKS_EXCLUDED(mutex_) {
    const absl::Duration now = clock_.Now();
    absl::MutexLock lock(&mutex_);
    Prune(now);
    const auto found = copies_.find(key);
    if (found == copies_.end()) return NoSuchSession(key.second);
    Copy& copy = found->second;
    if (!copy.lost.has_value()) copy.lost = now;
    if (now - *copy.lost < kWait) {
      return WithRetryDelay(
          absl::UnavailableError(
              "session_id: expected a session that the store has, received one that it has lost; "
              "another server may have it; try again"),
          kRetryDelay);
    }
    std::shared_ptr<SessionEntry> entry = std::move(copy.entry);
    copies_.erase(found);
    return entry;
  }

 private:
  static constexpr absl::Duration kRetryDelay = absl::Milliseconds(100);

  struct Copy {
    std::shared_ptr<SessionEntry> entry;
    absl::Duration since;
    std::optional<absl::Duration> lost = std::nullopt;  // since when the store has nothing
  };

  // Forgets those that nobody has asked for in time.
  void Prune(absl::Duration now) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    std::erase_if(copies_, [&](const auto& item) { return now - item.second.since > kKept; });
  }

  const Clock& clock_;
  absl::Mutex mutex_;
  std::map<Key, Copy> copies_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
