#include "core/open_sessions/closed_sessions.h"

#include <vector>

#include "absl/time/clock.h"
#include "core/open_sessions/session_entry.h"

namespace spikeserve {
namespace {

bool IsLost(const SessionEntry& entry) { return entry.journal != nullptr && entry.journal->lost(); }

}  // namespace

bool ClosedSessions::Keep(const std::string& id, const std::shared_ptr<SessionEntry>& entry) {
  if (IsLost(*entry)) return false;
  absl::Time until = absl::InfinitePast();
  {
    absl::MutexLock lock(&entry->mutex);
    const Session& session = entry->agent.session();
    const bool in_fleet =
        session.learner.has_value() && session.options.learning->scope == Scope::kFleet;
    if (!in_fleet || session.learner->waiting.empty()) return false;
    until = absl::UnixEpoch() + absl::Seconds(session.learner->waiting.back()->until);
    entry->agent.Compact();
  }
  absl::MutexLock lock(&mutex_);
  if (closed_.size() >= kMost) return false;
  closed_[{entry->tenant, id}] = {.entry = entry, .until = until};
  return true;
}

std::shared_ptr<SessionEntry> ClosedSessions::Find(const std::string& id,
                                                   const std::string& tenant) {
  absl::MutexLock lock(&mutex_);
  const auto found = closed_.find({tenant, id});
  const bool is_here = found != closed_.end() && !IsLost(*found->second.entry);
  return is_here ? found->second.entry : nullptr;
}

void ClosedSessions::Settle() {
  std::vector<std::shared_ptr<SessionEntry>> due;
  const absl::Time now = absl::Now();
  {
    absl::MutexLock lock(&mutex_);
    for (const auto& [name, closed] : closed_) {
      if (closed.until <= now || IsLost(*closed.entry)) due.push_back(closed.entry);
    }
  }
  for (const auto& entry : due) {
    absl::MutexLock lock(&entry->mutex);
    if (!IsLost(*entry) && entry->agent.Settle()) continue;  // the log of the head has it soon
    if (entry->journal != nullptr) entry->journal->OnClose();
    const std::pair<std::string, std::string> name = {entry->tenant, entry->agent.session().id};
    absl::MutexLock closed_lock(&mutex_);
    const auto found = closed_.find(name);
    if (found != closed_.end() && found->second.entry == entry) closed_.erase(found);
  }
}

}  // namespace spikeserve
