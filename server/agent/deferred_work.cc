#include "server/agent/deferred_work.h"

#include "absl/types/span.h"
#include "core/open_sessions/session_locks.h"
#include "server/agent/decision_request.h"

namespace spikeserve {

void DeferredWork::Run() {
  for (size_t first = 0; first < entries_.size(); first += kMaxSessionsPerGroup) {
    const auto part = absl::MakeConstSpan(entries_).subspan(first, kMaxSessionsPerGroup);
    const SessionLocks locks(part);
    absl::InlinedVector<AgentSession*, 1> sessions;
    for (const auto& entry : part) {
      entry->mutex.AssertHeld();
      sessions.push_back(&entry->agent);
    }
    AgentSession::AppendPendingActions(sessions);
    for (const auto& entry : part) {
      entry->mutex.AssertHeld();
      if (entry->shadow_steps == nullptr || entry->shadow_steps->empty()) continue;
      shadows_->Submit(entry->shadow, entry->served->version, entry->shadow_steps->Take());
    }
  }
  entries_.clear();
}

}  // namespace spikeserve
