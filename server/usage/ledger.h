// The ledger: what each tenant, policy, version and label has used, by hour.
//
// Nothing is added to a decision. Now and then, a thread looks at the totals of the open sessions
// and books what was answered: of SYNC, what the session store has acknowledged. The end of a
// session is booked before its journal is removed. What a server that was killed had not booked
// follows from the journals it left (FindOwnerless()). So decisions, spikes and joules by
// horowitz_45nm are exact for stored sessions, but for what a crash takes of ASYNC, which no client
// sends again. The rest, and sessions that are not stored, lose at most an interval.
//
// Thread-safe, except BookAll() and Tick(), which one thread calls at a time.
#pragma once

#include <atomic>
#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/clock.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "core/open_sessions/session_store.h"
#include "prometheus/metric_family.h"
#include "server/access/authenticator.h"
#include "server/usage/usage_store.h"

namespace spikeserve {

// Returns the totals of the sessions in the store that no living server holds.
using FindOwnerless = std::function<absl::StatusOr<std::vector<SessionTotals>>()>;

struct LedgerOptions {
  std::string process;  // a name that no other process has
  std::string label;    // key of the label that rows are distinguished by; empty: none
  absl::Duration session_life = absl::Hours(24);  // that the store keeps an unused session
  bool tenant_metrics = false;                    // series by tenant for Prometheus
  bool is_shared = false;                         // by the servers of a session store
  std::function<absl::Time()> now = [] { return absl::Now(); };
};

// The budgets of a tenant and what is spent of them.
struct TenantBudgets {
  std::string tenant;
  std::vector<BudgetState> budgets;
};

class Ledger {
 public:
  // All must outlive the ledger. `reads` is another connection to the same store, so that a long
  // read does not delay the end of a session; it may be `books`. `find_ownerless` may be null.
  Ledger(LedgerOptions options, std::shared_ptr<UsageStore> books,
         std::shared_ptr<UsageStore> reads, FindOwnerless find_ownerless, SessionStore* sessions,
         const Authenticator* authenticator, const Clock* clock);

  // Takes what is left of a session that is closed. Called before the journal ends, and again while
  // its episodes wait for verdicts: what they contribute to the head of a fleet.
  void OnClosed(SessionEntry& entry) ABSL_LOCKS_EXCLUDED(mutex_);
  // Books what OnClosed() has taken. Called before the ends of journals are written. If that fails,
  // it is tried again, and only a crash until then loses it.
  void BookEnds() ABSL_LOCKS_EXCLUDED(mutex_, book_mutex_);

  // Books what the open sessions have used. Returns false if something could not be booked yet.
  bool BookAll() ABSL_LOCKS_EXCLUDED(mutex_, book_mutex_);
  // As BookAll(), tells tenants what they have spent, and, when it is
  // due, looks for journals without an owner and compacts the store.
  void Tick() ABSL_LOCKS_EXCLUDED(mutex_, book_mutex_);
  // Has the next Tick() look for journals without an owner: a server is gone.
  void OnServerGone() { find_ownerless_.store(true, std::memory_order_relaxed); }

  // Tells tenants what they have spent. Logs if the store cannot be reached.
  void FollowMonth() ABSL_LOCKS_EXCLUDED(mutex_);

  absl::StatusOr<std::vector<UsageRow>> Read(absl::Time from, absl::Time to) const {
    return ReadUsage(*reads_, from, to);
  }
  std::vector<TenantBudgets> Budgets() const;
  const std::string& label() const { return options_.label; }
  bool is_shared() const { return options_.is_shared; }
  absl::Time Now() const { return options_.now(); }

  // Returns the metrics of budgets and, if LedgerOptions::tenant_metrics, of the tenants that have
  // used most in this month.
  std::vector<prometheus::MetricFamily> Collect() const ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  struct Pending {
    std::map<std::string, UsageCounts> added = {};  // by series
    std::vector<SessionTotals> totals = {};

    void Add(Pending more);
  };

  Pending TakeClosed() ABSL_LOCKS_EXCLUDED(mutex_);

  // Adds what the session has used since it was booked.
  void Take(SessionEntry& entry, bool is_closed, Pending* pending) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex);
  // Adds the calls of the tenants since they were booked.
  void TakeTenants(Pending* pending);
  // Books all of `pending`, the closed sessions, and what could not be booked before. Returns false
  // if something is left.
  bool Book(Pending pending) ABSL_LOCKS_EXCLUDED(mutex_, book_mutex_);
  void BookOwnerless() ABSL_LOCKS_EXCLUDED(book_mutex_);
  void Maintain();
  void Note(const char* what, const absl::Status& status) const;

  const LedgerOptions options_;
  const std::shared_ptr<UsageStore> books_;
  const std::shared_ptr<UsageStore> reads_;
  const FindOwnerless finds_ownerless_;
  SessionStore& sessions_;
  const Authenticator& authenticator_;
  const Clock& clock_;
  std::atomic<bool> find_ownerless_ = true;

  // Of the thread of Tick():
  std::map<std::string, std::pair<int64_t, int64_t>> calls_;  // refusals and bytes, by tenant
  absl::Duration maintained_ = -absl::InfiniteDuration();     // of `clock_`

  mutable absl::Mutex mutex_;
  Pending closed_ ABSL_GUARDED_BY(mutex_);
  std::map<std::string, UsageCounts> month_ ABSL_GUARDED_BY(mutex_);  // by tenant

  absl::Mutex book_mutex_;
  std::deque<UsageBatch> unbooked_ ABSL_GUARDED_BY(book_mutex_);
  uint64_t batches_ ABSL_GUARDED_BY(book_mutex_) = 0;
};

}  // namespace spikeserve
