#include "server/agent/trace_record.h"

#include "absl/status/status.h"

namespace spikeserve {

void TraceRecord(const Span& call, const SessionEntry& entry,
                 const std::shared_ptr<FleetContribution>& contribution) {
  if (!call || entry.journal == nullptr) return;
  // Shared, because functions must be copyable.
  const auto append = std::make_shared<Span>(call.Store("append"));
  const auto merge = std::make_shared<Span>(contribution == nullptr ? Span() : call.Store("merge"));
  entry.journal->WhenDurable(entry.journal->written(),
                             [append, merge, contribution](const absl::Status& status) {
                               append->Fail(status);
                               append->End();
                               if (contribution == nullptr) return;
                               merge->Restart();
                               if (!status.ok()) return merge->Fail(status);
                               contribution->WhenMerged([merge](const absl::Status& merged) {
                                 merge->Fail(merged);
                                 merge->End();
                               });
                             });
}

}  // namespace spikeserve
