#include "server/agent/durable_answer.h"

namespace spikeserve {

void AddStored(const SessionEntry& entry, Commits* commits) {
  if (entry.journal == nullptr) return;
  commits->push_back({entry.journal, entry.journal->written()});
}

void AddCommit(const SessionEntry& entry, Commits* commits) {
  const auto& last = entry.agent.session().last_answer;
  const bool of_operator = last.has_value() && last->source.kind == SourceKind::kOperator;
  if (entry.journal == nullptr || (!entry.journal->is_sync() && !of_operator)) return;
  AddStored(entry, commits);
}

void AddConfirmation(const SessionEntry& entry, bool has_decided, Commits* commits) {
  if (entry.journal == nullptr) return;
  if (!entry.journal->is_shared()) return AddCommit(entry, commits);
  if (!has_decided) entry.journal->OnConfirm();
  AddStored(entry, commits);
}

absl::Status CheckMayBeHeard(const SessionEntry& entry) {
  const bool is_heard = entry.agent.seat() != nullptr && entry.agent.hold() == nullptr;
  if (!is_heard || entry.journal == nullptr) return absl::OkStatus();
  return entry.journal->CheckReachable();
}

}  // namespace spikeserve
