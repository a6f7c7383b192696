#include "server/agent/durable_answer.h"

namespace spikeserve {

void AddCommit(const SessionEntry& entry, Commits* commits) {
  if (entry.journal == nullptr || !entry.journal->is_sync()) return;
  commits->push_back({entry.journal, entry.journal->written()});
}

void AddConfirmation(const SessionEntry& entry, bool has_decided, Commits* commits) {
  if (entry.journal == nullptr) return;
  if (!entry.journal->is_shared()) return AddCommit(entry, commits);
  if (!has_decided) entry.journal->OnConfirm();
  commits->push_back({entry.journal, entry.journal->written()});
}

}  // namespace spikeserve
