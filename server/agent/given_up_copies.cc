#include "server/agent/given_up_copies.h"

#include "absl/status/status.h"
#include "core/session/session_id.h"
#include "server/base/retry_delay.h"

namespace spikeserve {
namespace {

constexpr absl::Duration kRetryDelay = absl::Milliseconds(100);

}  // namespace

void GivenUpCopies::Keep(const Key& key, const std::shared_ptr<SessionEntry>& entry) {
  const absl::Duration now = clock_.Now();
  absl::MutexLock lock(&mutex_);
  if (copies_.size() >= kMost) Prune(now);
  if (copies_.size() < kMost) copies_.try_emplace(key, Copy{.entry = entry, .since = now});
}

std::shared_ptr<SessionEntry> GivenUpCopies::Take(const Key& key) {
  absl::MutexLock lock(&mutex_);
  const auto found = copies_.find(key);
  if (found == copies_.end()) return nullptr;
  std::shared_ptr<SessionEntry> entry = std::move(found->second.entry);
  copies_.erase(found);
  return entry;
}

void GivenUpCopies::WaitAgain(const Key& key) {
  absl::MutexLock lock(&mutex_);
  if (const auto found = copies_.find(key); found != copies_.end()) found->second.lost.reset();
}

absl::StatusOr<std::shared_ptr<SessionEntry>> GivenUpCopies::TakeBack(const Key& key) {
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

void GivenUpCopies::Prune(absl::Duration now) {
  std::erase_if(copies_, [&](const auto& item) { return now - item.second.since > kKept; });
}

}  // namespace spikeserve
