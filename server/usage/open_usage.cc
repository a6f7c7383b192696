#include "server/usage/open_usage.h"

#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/engine/energy.h"
#include "core/journal/journal_entry.h"
#include "core/session/session_id.h"
#include "core/store/store_reader.h"
#include "server/base/log.h"
#include "server/store/open_store.h"

namespace spikeserve {
namespace {

// Adds the totals of a journal to `found`, or says that it cannot be read.
void AddTotals(const std::string& id, absl::Span<const std::string> records,
               const std::string& label, std::vector<SessionTotals>* found) {
  auto totals = TotalsOfJournal(id, records, label);
  if (totals.ok()) return found->push_back(*std::move(totals));
  LogWarning("journal not read for the ledger",
             {{"session", id}, {"error", totals.status().message()}});
}

}  // namespace

absl::StatusOr<SessionTotals> TotalsOfJournal(const std::string& id,
                                              absl::Span<const std::string> records,
                                              const std::string& label) {
  ASSIGN_OR_RETURN(const Journal journal, ParseJournal(records));
  const Session& session = journal.snapshot;
  auto decisions = session.decisions;
  auto spikes = static_cast<double>(session.spikes);
  double joules = session.energy_joules;
  for (const JournalEntry& entry : journal.entries) {
    if (entry.decision < decisions) continue;  // written again
    const Counts& counts = entry.answer.counts;
    ModelConfig config;
    if (counts.total_spikes() == 0) config.mode = Mode::kDense;
    ++decisions;
    spikes += static_cast<double>(counts.total_spikes());
    joules += DefaultEnergy(counts, config);
  }
  return SessionTotals{.session = id,
                       .series = SeriesOf(session.options, label).ToKey(),
                       .totals = {static_cast<double>(decisions), spikes, joules}};
}

JournalVisitor UsageStores::visitor() {
  return {.begin = [this](const std::string& directory) -> absl::Status {
            ASSIGN_OR_RETURN(local_, LocalUsageStore::Open(absl::StrCat(directory, "/usage")));
            return absl::OkStatus();
          },
          .wants =
              [this](const std::string& id, uint64_t decisions) {
                stored_.insert(id);
                return local_->BookedDecisions(id) < static_cast<double>(decisions);
              },
          .visit =
              [this](const std::string& id, const std::vector<std::string>& records) {
                AddTotals(id, records, usage_options_.label, &found_);
              },
          .end = [this] { return local_->ForgetAllBut(std::exchange(stored_, {})); }};
}

absl::Status UsageStores::Open() {
  ASSIGN_OR_RETURN(process, NewSessionId());  // any random name
  const std::string& directory = usage_options_.directory;
  if (!directory.empty() && store_options_.address != "memory") {
    return InvalidArgument("--usage_dir", "none, because the ledger is in --session_store",
                           directory);
  }
  ASSIGN_OR_RETURN(auto redis, RedisOptionsOf(store_options_));
  if (redis.has_value()) {
    books = NewRedisUsageStore(*redis);
    reads = NewRedisUsageStore(*redis);
    find_ownerless = [options = *redis, label = usage_options_.label] {
      std::vector<SessionTotals> found;
      const auto status =
          VisitOwnerless(options, /*whole=*/true, [&](const auto& id, const auto& records) {
            if (!records.empty()) AddTotals(id, records, label, &found);
          });
      return status.ok() ? absl::StatusOr<std::vector<SessionTotals>>(std::move(found)) : status;
    };
    return absl::OkStatus();
  }
  if (local_ == nullptr) {
    auto opened = LocalUsageStore::Open(directory);
    if (!opened.ok()) return Annotate(opened.status(), "--usage_dir");
    local_ = *std::move(opened);
  }
  books = reads = local_;
  find_ownerless = [found = std::move(found_)] { return found; };
  return absl::OkStatus();
}

}  // namespace spikeserve
