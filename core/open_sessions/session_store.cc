#include "core/open_sessions/session_store.h"

#include <algorithm>
#include <optional>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "core/base/json.h"
#include "core/base/status_macros.h"
#include "core/session/session_id.h"
#include "core/session/session_value.h"

namespace spikeserve {
namespace {

constexpr size_t kPrefetched = 4;  // sessions

// Prefetches the constant parts of a session and its count of references into the caches of the
// processor.
void PrefetchHead(const SessionEntry& entry) {
  __builtin_prefetch(&entry);
  __builtin_prefetch(&entry.label_text);
  __builtin_prefetch(&entry.mutex);
}

// Loads the counters of a session's life into the caches. Reads nothing, and so needs no lock.
void PrefetchCounters(const SessionEntry& entry) ABSL_NO_THREAD_SAFETY_ANALYSIS {
  __builtin_prefetch(&entry.agent.session().energy_joules);
}

}  // namespace

SessionStore::SessionStore(int64_t max_sessions, const Clock* clock)
    : max_sessions_(max_sessions), clock_(clock) {}

void SessionStore::NotifyClosed(const std::string& id, const std::shared_ptr<SessionEntry>& entry) {
  entry->served->observer->OnClose();
  if (on_closed_ != nullptr) on_closed_(*entry);
  if (!closed_.Keep(id, entry)) Forget(*entry);
}

void SessionStore::Forget(const SessionEntry& entry) {
  size_.fetch_sub(1);
  if (entry.quota != nullptr) entry.quota->Release();
  if (entry.journal != nullptr) entry.journal->OnClose();
}

SessionStore::Shard& SessionStore::ShardOf(absl::string_view id) {
  return shards_[absl::HashOf(id) % kShards];
}

absl::StatusOr<std::string> SessionStore::Open(std::shared_ptr<const ServedPolicy> served,
                                               SessionOptions options, SessionExtras extras) {
  absl::StatusOr<std::string> id = extras.id;
  if (id->empty()) id = NewSessionId();
  if (!id.ok()) return id;
  RETURN_IF_ERROR(Add(std::move(served), NewSession(*id, std::move(options)), std::move(extras),
                      /*is_new=*/true));
  return id;
}

absl::Status SessionStore::Restore(std::shared_ptr<const ServedPolicy> served, Session session,
                                   SessionExtras extras) {
  return Add(std::move(served), std::move(session), std::move(extras), /*is_new=*/false);
}

absl::Status SessionStore::Add(std::shared_ptr<const ServedPolicy> served, Session session,
                               SessionExtras extras, bool is_new) {
  if (draining()) {
    return absl::UnavailableError(
        "draining: this server opens no new sessions; try another server");
  }
  if (size_.fetch_add(1) >= max_sessions_) {
    size_.fetch_sub(1);
    return absl::ResourceExhaustedError(
        absl::StrCat("max_sessions: expected fewer than ", max_sessions_,
                     " open sessions; close one, or wait until one is idle for its time-to-live"));
  }
  if (extras.quota != nullptr) {
    if (auto status = extras.quota->Acquire(); !status.ok()) {
      size_.fetch_sub(1);
      return status;
    }
  }
  const std::shared_ptr<SessionObserver> observer = served->observer;
  const std::string id = session.id;
  const auto entry = std::make_shared<SessionEntry>(std::move(served), std::move(session), clock_);
  entry->shadow = std::move(extras.shadow);
  entry->quota = extras.quota;
  entry->journal = std::move(extras.journal);
  // Held until the journal has the session: a request that finds it now waits.
  absl::MutexLock lock(&entry->mutex);
  if (entry->shadow != nullptr) {
    entry->shadow_steps = std::make_shared<ShadowSteps>();
    entry->agent.AddListener(entry->shadow_steps);
  }
  entry->recorder = std::move(extras.recorder);
  if (entry->recorder != nullptr) entry->agent.AddListener(entry->recorder);
  if (!Insert(id, entry)) {
    size_.fetch_sub(1);
    if (extras.quota != nullptr) extras.quota->Release();
    return absl::AlreadyExistsError(
        absl::StrCat("session_id: expected one that is not open, received ", Quoted(id)));
  }
  if (entry->journal != nullptr) {
    entry->agent.AddListener(entry->journal);
    if (is_new) entry->journal->OnOpen(entry->agent.session());
  }
  // The server that had the session may not have appended it; the log takes it once.
  if (entry->agent.contribution() != nullptr) entry->agent.contribution()->Append();
  observer->OnOpen();
  if (!extras.assigned) return absl::OkStatus();
  if (auto evidence = observer->OnAssigned(entry->tenant); evidence != nullptr) {
    entry->agent.AddListener(std::move(evidence));
  }
  return absl::OkStatus();
}

bool SessionStore::Insert(const std::string& id, std::shared_ptr<SessionEntry> entry) {
  Slot slot = {.entry = std::move(entry), .last_used = clock_->Now()};
  Shard& shard = ShardOf(id);
  absl::MutexLock lock(&shard.mutex);
  const std::string* const tenant = &slot.entry->tenant;
  return shard.slots.try_emplace(Name{id, tenant}, std::move(slot)).second;
}

absl::StatusOr<std::shared_ptr<SessionEntry>> SessionStore::Find(absl::string_view id,
                                                                 absl::string_view tenant) {
  const absl::Duration now = clock_->Now();
  std::shared_ptr<SessionEntry> lost;  // destroyed outside the lock
  {
    Shard& shard = ShardOf(id);
    absl::MutexLock lock(&shard.mutex);
    const auto it = shard.slots.find(NameView{id, tenant});
    if (it == shard.slots.end()) return NoSuchSession(id);
    Slot& slot = it->second;
    if (slot.entry->journal == nullptr || !slot.entry->journal->lost()) {
      slot.last_used = now;
      slot.compacted = false;
      return slot.entry;
    }
    lost = std::move(slot.entry);
    shard.slots.erase(it);
  }
  NotifyClosed(std::string(id), lost);
  return NoSuchSession(id);
}

SessionStore::Slots::iterator SessionStore::Look(Shard& shard, absl::string_view id,
                                                 absl::string_view tenant) {
  const auto own = shard.slots.find(NameView{id, tenant});
  return own != shard.slots.end() ? own : shard.slots.find(NameView{id, std::nullopt});
}

std::shared_ptr<SessionEntry> SessionStore::Peek(absl::string_view id, absl::string_view tenant) {
  Shard& shard = ShardOf(id);
  absl::MutexLock lock(&shard.mutex);
  const auto it = Look(shard, id, tenant);
  return it == shard.slots.end() ? nullptr : it->second.entry;
}

std::optional<ListedSession> SessionStore::PeekListed(absl::string_view id,
                                                      absl::string_view tenant) {
  const absl::Duration now = clock_->Now();
  Shard& shard = ShardOf(id);
  absl::MutexLock lock(&shard.mutex);
  const auto it = Look(shard, id, tenant);
  if (it == shard.slots.end()) return std::nullopt;
  return ListedSession{
      .id = it->first.id, .entry = it->second.entry, .idle = now - it->second.last_used};
}

absl::Status SessionStore::Close(absl::string_view id, absl::string_view tenant) {
  std::shared_ptr<SessionEntry> entry;  // destroyed outside the lock
  Shard& shard = ShardOf(id);
  {
    absl::MutexLock lock(&shard.mutex);
    const auto it = shard.slots.find(NameView{id, tenant});
    if (it == shard.slots.end()) return NoSuchSession(id);
    entry = std::move(it->second.entry);
    shard.slots.erase(it);
  }
  NotifyClosed(std::string(id), entry);
  return absl::OkStatus();
}

std::vector<ListedSession> SessionStore::ListAfter(
    absl::string_view after, size_t limit, absl::FunctionRef<bool(const SessionEntry&)> wanted) {
  const absl::Duration now = clock_->Now();
  const auto by_id = [](const auto& a, const auto& b) { return a.id < b.id; };
  std::vector<ListedSession> first;  // a heap, the last id at its front
  for (Shard& shard : shards_) {
    absl::MutexLock lock(&shard.mutex);
    for (const auto& [name, slot] : shard.slots) {
      const std::string& id = name.id;
      const bool is_full = first.size() == limit;
      if (!wanted(*slot.entry) || id <= after || (is_full && id >= first.front().id)) continue;
      if (is_full) {
        std::pop_heap(first.begin(), first.end(), by_id);
        first.pop_back();
      }
      first.push_back({.id = id, .entry = slot.entry, .idle = now - slot.last_used});
      std::push_heap(first.begin(), first.end(), by_id);
    }
  }
  std::sort_heap(first.begin(), first.end(), by_id);
  return first;
}

void SessionStore::ForEach(absl::FunctionRef<bool(const SessionEntry&)> wanted,
                           absl::FunctionRef<void(const ListedSession&)> visit) {
  struct Visited {
    std::shared_ptr<SessionEntry> entry;
    absl::Duration idle;
    size_t id_end;  // in `ids`
  };
  const absl::Duration now = clock_->Now();
  std::vector<Visited> sessions;  // of one shard, visited without its lock
  std::string ids;                // one after the other, so that none needs memory of its own
  ListedSession listed;
  for (Shard& shard : shards_) {
    sessions.clear();
    ids.clear();
    {
      absl::MutexLock lock(&shard.mutex);
      sessions.reserve(shard.slots.size());
      // Ids and sessions lie anywhere in memory: one loop asks for all of them, so that the next
      // one does not wait for each.
      for (const auto& [name, slot] : shard.slots) {
        __builtin_prefetch(name.id.data());
        PrefetchHead(*slot.entry);
      }
      for (const auto& [name, slot] : shard.slots) {
        if (!wanted(*slot.entry)) continue;
        ids += name.id;
        sessions.push_back({slot.entry, now - slot.last_used, ids.size()});
      }
    }
    size_t id_begin = 0;
    for (size_t i = 0; i < sessions.size(); ++i) {
      if (i + kPrefetched < sessions.size()) {
        __builtin_prefetch(sessions[i + kPrefetched].entry->label_text.data());
        PrefetchCounters(*sessions[i + kPrefetched].entry);
      }
      listed.id.assign(ids, id_begin, sessions[i].id_end - id_begin);
      listed.entry = std::move(sessions[i].entry);
      listed.idle = sessions[i].idle;
      visit(listed);
      id_begin = sessions[i].id_end;
    }
  }
}

std::vector<ListedSession> SessionStore::List(absl::FunctionRef<bool(const SessionEntry&)> wanted) {
  std::vector<ListedSession> list;
  ForEach(wanted, [&](const ListedSession& session) { list.push_back(session); });
  std::sort(list.begin(), list.end(), [](const auto& a, const auto& b) { return a.id < b.id; });
  return list;
}

void SessionStore::Forgive(absl::Duration time) {
  const absl::Duration now = clock_->Now();
  for (Shard& shard : shards_) {
    absl::MutexLock lock(&shard.mutex);
    for (auto& [name, slot] : shard.slots) slot.last_used = std::min(now, slot.last_used + time);
  }
}

int64_t SessionStore::RemoveIdle(absl::Duration time_to_live) {
  const absl::Duration oldest = clock_->Now() - time_to_live;
  // Destroyed outside the locks.
  std::vector<std::pair<std::string, std::shared_ptr<SessionEntry>>> idle;
  for (Shard& shard : shards_) {
    absl::MutexLock lock(&shard.mutex);
    absl::erase_if(shard.slots, [&](auto& item) {
      Slot& slot = item.second;
      // References are taken only under this mutex, so a count of one is the store's own and stays
      // one.
      if (slot.last_used > oldest || slot.entry.use_count() > 1) return false;
      idle.emplace_back(item.first.id, std::move(slot.entry));
      return true;
    });
  }
  for (const auto& [id, entry] : idle) NotifyClosed(id, entry);
  const auto report = [&](SessionEntry& entry) {
    if (on_closed_ != nullptr) on_closed_(entry);
  };
  for (const auto& entry : closed_.Settle(report)) Forget(*entry);
  return static_cast<int64_t>(idle.size());
}

int64_t SessionStore::CompactIdle(absl::Duration idle_for) {
  const absl::Duration oldest = clock_->Now() - idle_for;
  int64_t compacted = 0;
  for (Shard& shard : shards_) {
    std::vector<std::shared_ptr<SessionEntry>> idle;
    {
      absl::MutexLock lock(&shard.mutex);
      for (auto& [name, slot] : shard.slots) {
        if (slot.compacted || slot.last_used > oldest || slot.entry.use_count() > 1) continue;
        slot.compacted = true;
        idle.push_back(slot.entry);
      }
    }
    for (const auto& entry : idle) {
      absl::MutexLock lock(&entry->mutex);
      entry->agent.Compact();
    }
    compacted += static_cast<int64_t>(idle.size());
  }
  return compacted;
}

}  // namespace spikeserve
