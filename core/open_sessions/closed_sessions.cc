#include "core/open_sessions/closed_sessions.h"

#include <algorithm>
#include <utility>

#include "absl/time/clock.h"
#include "core/open_sessions/session_entry.h"

namespace spikeserve {
namespace {

// How long the last verdict gets its answer again.
constexpr absl::Duration kRepeated = absl::Minutes(1);

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
  closed_.emplace(std::pair(entry->tenant, id), Closed{.entry = entry, .until = until});
  return true;
}

std::shared_ptr<SessionEntry> ClosedSessions::Find(const std::string& id,
                                                   const std::string& tenant) {
  absl::MutexLock lock(&mutex_);
  const auto [begin, end] = closed_.equal_range({tenant, id});
  const auto found =
      std::find_if(begin, end, [](const auto& item) { return !IsLost(*item.second.entry); });
  return found == end ? nullptr : found->second.entry;
}

std::vector<std::shared_ptr<SessionEntry>> ClosedSessions::Settle(
    absl::FunctionRef<void(SessionEntry&)> visit) {
  std::vector<std::shared_ptr<SessionEntry>> waiting;
  {
    absl::MutexLock lock(&mutex_);
    for (const auto& [name, closed] : closed_) waiting.push_back(closed.entry);
  }
  std::erase_if(waiting, [&](const auto& entry) {
    bool waits = false;
    {
      absl::MutexLock lock(&entry->mutex);
      waits = !IsLost(*entry) && entry->agent.Settle();
    }
    visit(*entry);
    return !waits;
  });
  std::ranges::sort(waiting);
  const absl::Time now = absl::Now();
  std::vector<std::shared_ptr<SessionEntry>> forgotten;
  absl::MutexLock lock(&mutex_);
  for (auto item = closed_.begin(); item != closed_.end();) {
    Closed& closed = item->second;
    const bool waits = std::ranges::binary_search(waiting, closed.entry);
    if (!waits) closed.until = std::min(closed.until, now + kRepeated);
    if (waits || (closed.until > now && !IsLost(*closed.entry))) {
      ++item;
    } else {
      forgotten.push_back(std::move(closed.entry));
      item = closed_.erase(item);
    }
  }
  return forgotten;
}

int64_t ClosedSessions::size() const {
  absl::MutexLock lock(&mutex_);
  return static_cast<int64_t>(closed_.size());
}

}  // namespace spikeserve
