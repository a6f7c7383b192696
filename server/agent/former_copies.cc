#include "server/agent/former_copies.h"

#include "absl/status/status.h"
#include "core/session/session_journal.h"
#include "server/base/retry_delay.h"

namespace spikeserve {
namespace {

constexpr absl::Duration kRetryDelay = absl::Milliseconds(100);

// Returns whether the copy was given up by this server itself, and no other owner is known.
bool IsGivenUp(const SessionEntry& entry) {
  if (entry.journal == nullptr || !entry.journal->is_shared() || !entry.journal->lost()) {
    return false;
  }
  absl::Status refusal;  // told at once, because nothing is to be written
  entry.journal->WhenDurable(0, [&](const absl::Status& status) { refusal = status; });
  return refusal.ok();
}

}  // namespace

void FormerCopies::Keep(const Key& key, const std::shared_ptr<SessionEntry>& entry) {
  if (entry == nullptr || entry->tenant != key.first || !IsGivenUp(*entry)) return;
  const absl::Duration now = clock_.Now();
  absl::MutexLock lock(&mutex_);
  if (copies_.size() >= kMost) Prune(now);
  if (copies_.size() < kMost) copies_.try_emplace(key, Copy{.entry = entry, .since = now});
}

void FormerCopies::Forget(const Key& key) {
  absl::MutexLock lock(&mutex_);
  copies_.erase(key);
}

absl::StatusOr<std::shared_ptr<SessionEntry>> FormerCopies::TakeBack(const Key& key) {
  const absl::Duration now = clock_.Now();
  absl::MutexLock lock(&mutex_);
  Prune(now);
  const auto found = copies_.find(key);
  if (found == copies_.end()) return NoSuchSession(key.second);
  if (now - found->second.since < kWait) {
    return WithRetryDelay(
        absl::UnavailableError(
            "session_id: expected a session that the store has, received one that it has lost; "
            "another server may have it; try again"),
        kRetryDelay);
  }
  std::shared_ptr<SessionEntry> entry = std::move(found->second.entry);
  copies_.erase(found);
  // The store may have told meanwhile that another server had taken the session over.
  if (!IsGivenUp(*entry)) return NoSuchSession(key.second);
  return entry;
}

void FormerCopies::Prune(absl::Duration now) {
  std::erase_if(copies_, [&](const auto& item) { return now - item.second.since > kKept; });
}

}  // namespace spikeserve
