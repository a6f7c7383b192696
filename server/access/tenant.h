// A tenant: one of the users that share a server. Owns sessions and has its own limits.
//
// Thread-safe. AcquireDecision and CheckMessage take no lock.
#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/open_sessions/session_quota.h"
#include "core/session/durability.h"
#include "core/session/usage.h"
#include "server/access/rate_limit.h"
#include "server/access/refusal_pacer.h"
#include "server/base/byte_budget.h"
#include "server/base/method.h"

namespace spikeserve {

// Calls a second of each class of costs, on average; one second's calls may come at once. 0: no
// limit. The defaults keep a tenant below about a fifth of a core in each class.
struct CallRates {
  double light = 5000.0;
  double listing = 100.0;
  double explain = 20.0;
  double operators = 100.0;
};

// What a tenant may use in a calendar month of UTC. 0: no budget.
struct UsageBudgets {
  double decisions = 0.0;
  std::map<std::string, double> joules;  // by energy model
  double contributions = 0.0;            // to the heads of a fleet
  bool stop_open_sessions = false;       // true: a spent budget also refuses decisions
};

// A budget of a tenant, and what was booked in the running month.
struct BudgetState {
  std::string name;  // decisions, joules.<model> or contributions
  double limit = 0.0;
  double spent = 0.0;
};

// The limits of one tenant. 0 means that only the limits of the server apply.
struct TenantLimits {
  // Open at the same time. Absent: the default share, if the server has more than one tenant.
  std::optional<int64_t> max_sessions;
  double decisions_per_second = 0.0;  // on average; one second's decisions may come at once
  CallRates calls_per_second;
  int64_t max_message_bytes = 0;                  // of one request
  Durability max_durability = Durability::kSync;  // of a session
  UsageBudgets budgets;

  // Returns INVALID_ARGUMENT that names the field, the expected and the received value.
  absl::Status Validate() const;
};

// Returns the field of an energy model that the ledger has. INVALID_ARGUMENT for other names.
absl::StatusOr<UsageField> FieldOfJoules(absl::string_view model);

class Tenant final : public SessionQuota {
 public:
  explicit Tenant(std::string name) : name_(std::move(name)) {}

  const std::string& name() const { return name_; }

  // Replaces the limits. `default_sessions` applies if max_sessions is absent; 0 is no limit. Open
  // sessions stay open, even if there are more than the new limit.
  void SetLimits(const TenantLimits& limits, int64_t default_sessions = 0);

  absl::Status Acquire() override;
  void Release() override { sessions_.fetch_sub(1, std::memory_order_relaxed); }

  // Returns RESOURCE_EXHAUSTED if a budget is spent that stops open sessions, too. Otherwise counts
  // one decision at time `now` of a monotonic clock, the same clock in every call. Returns
  // RESOURCE_EXHAUSTED with google.rpc.RetryInfo if decisions_per_second is exceeded.
  absl::Status AcquireDecision(absl::Duration now);

  // Counts one call of a method at time `now`, as above. Returns RESOURCE_EXHAUSTED with
  // google.rpc.RetryInfo if the rate of its class is exceeded. Decisions are not counted here. A
  // tenant without SetLimits() has no rates.
  absl::Status AcquireCall(Cost cost, absl::Duration now);

  // Tells what the tenant has used in the month that ends at `reset`. Budgets that reach 80 % or
  // 100 % are logged, once in a month each.
  void SetSpent(const UsageCounts& spent, absl::Time reset) ABSL_LOCKS_EXCLUDED(budgets_mutex_);
  std::vector<BudgetState> Budgets() const ABSL_LOCKS_EXCLUDED(budgets_mutex_);

  // Returns RESOURCE_EXHAUSTED, with the time of the reset, if a budget is spent, so that no
  // session may be opened.
  absl::Status CheckBudgets() const ABSL_LOCKS_EXCLUDED(budgets_mutex_);

  // Counts the bytes of a message that the server has received.
  void CountReceived(int64_t bytes) { received_bytes_.fetch_add(bytes, std::memory_order_relaxed); }
  int64_t received_bytes() const { return received_bytes_.load(std::memory_order_relaxed); }

  // Returns the highest durability that sessions of the tenant may have.
  Durability max_durability() const { return max_durability_.load(std::memory_order_relaxed); }

  // Returns true if decisions_per_second limits the tenant.
  bool limits_decisions() const { return decisions_.is_limited(); }

  // Returns RESOURCE_EXHAUSTED if a request of `bytes` is longer than max_message_bytes.
  absl::Status CheckMessage(int64_t bytes) const;

  // Returns the length of its longest request in bytes; `limit` is that of the server.
  int64_t LongestMessage(int64_t limit) const;

  // What the calls of this tenant store in the transport.
  ByteBudget& bytes_in_flight() { return bytes_in_flight_; }

  // Delays the refusals of all callers of this tenant.
  RefusalPacer& refusals() { return refusals_; }

 private:
  void JudgeBudgets() ABSL_EXCLUSIVE_LOCKS_REQUIRED(budgets_mutex_);
  std::vector<BudgetState> StatesOfBudgets() const ABSL_SHARED_LOCKS_REQUIRED(budgets_mutex_);

  const std::string name_;
  RateLimit decisions_;
  std::array<RateLimit, kCosts> calls_;  // by class of costs
  RefusalPacer refusals_;
  ByteBudget bytes_in_flight_;
  std::atomic<int64_t> max_sessions_ = 0;
  std::atomic<int64_t> max_message_bytes_ = 0;
  std::atomic<Durability> max_durability_ = Durability::kSync;
  std::atomic<int64_t> sessions_ = 0;
  std::atomic<int64_t> received_bytes_ = 0;
  std::atomic<bool> is_spent_ = false;    // a budget
  std::atomic<bool> stops_open_ = false;  // decisions, because a budget is spent
  mutable absl::Mutex budgets_mutex_;
  UsageBudgets budgets_ ABSL_GUARDED_BY(budgets_mutex_);
  UsageCounts spent_ ABSL_GUARDED_BY(budgets_mutex_);
  absl::Time reset_ ABSL_GUARDED_BY(budgets_mutex_) = absl::InfiniteFuture();
  std::map<std::string, double> said_ ABSL_GUARDED_BY(budgets_mutex_);  // ratio, by budget
};

}  // namespace spikeserve
