// Opens the store of the ledger, beside the session store.
//
//   UsageStores usage(options);
//   ASSIGN_OR_RETURN(auto store, OpenStore(options.store, registry, usage.visitor()));
//   RETURN_IF_ERROR(usage.Open());
//
// Not thread-safe.
#pragma once

#include <memory>
#include <set>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "server/store/file_backend.h"
#include "server/store/store_options.h"
#include "server/usage/ledger.h"
#include "server/usage/usage_store.h"

namespace spikeserve {

struct UsageOptions {
  std::string directory;  // of the ledger of sessions that are not stored; empty: memory
  std::string label;      // as LedgerOptions, as the next
  absl::Duration interval = absl::Seconds(10);
  bool tenant_metrics = false;
};

class UsageStores {
 public:
  UsageStores(const StoreOptions& store, const UsageOptions& usage)
      : store_options_(store), usage_options_(usage) {}

  // Reads from the journals of a file store what a crash has left unbooked. Used while this object
  // lives.
  JournalVisitor visitor();
  // Returns INVALID_ARGUMENT, which names the flag, if the ledger cannot be kept.
  absl::Status Open();

  std::string process;  // identifies this one in the ledger
  std::shared_ptr<UsageStore> books;
  std::shared_ptr<UsageStore> reads;
  FindOwnerless find_ownerless;

 private:
  const StoreOptions store_options_;
  const UsageOptions usage_options_;
  std::shared_ptr<LocalUsageStore> local_;
  std::set<std::string> stored_;  // sessions, while their journals are visited
  std::vector<SessionTotals> found_;
};

// Returns what a journal says of its session. DATA_LOSS if it is damaged. What the entries after
// the snapshot have used is estimated as for a policy with spikes if they have any.
absl::StatusOr<SessionTotals> TotalsOfJournal(const std::string& id,
                                              absl::Span<const std::string> records,
                                              const std::string& label);

}  // namespace spikeserve
