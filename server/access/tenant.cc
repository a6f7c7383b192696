#include "server/access/tenant.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "server/base/log.h"
#include "server/base/retry_delay.h"

namespace spikeserve {
namespace {

struct NamedRate {
  Cost cost;
  absl::string_view name;  // in the tokens file
  double per_second;
};

std::array<NamedRate, 4> RatesOf(const CallRates& rates) {
  return {{{Cost::kLight, "light", rates.light},
           {Cost::kListing, "listing", rates.listing},
           {Cost::kExplain, "explain", rates.explain},
           {Cost::kOperator, "operator", rates.operators}}};
}

absl::string_view NameOf(Cost cost) {
  for (const NamedRate& rate : RatesOf({})) {
    if (rate.cost == cost) return rate.name;
  }
  return "decision";
}

constexpr double kAlertRatio = 0.8;

absl::Status CheckBudgetLimits(const UsageBudgets& budgets) {
  const auto check = [](absl::string_view field, double limit) {
    if (std::isfinite(limit) && limit >= 0.0) return absl::OkStatus();
    return InvalidArgument(absl::StrCat("budgets.", field), "a number of at least 0", limit);
  };
  RETURN_IF_ERROR(check("decisions", budgets.decisions));
  RETURN_IF_ERROR(check("contributions", budgets.contributions));
  for (const auto& [model, limit] : budgets.joules) {
    RETURN_IF_ERROR(FieldOfJoules(model).status());
    RETURN_IF_ERROR(check(absl::StrCat("joules.", model), limit));
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<UsageField> FieldOfJoules(absl::string_view model) {
  for (const UsageField field : kJoulesFields) {
    if (ToString(field) == model) return field;
  }
  return InvalidArgument("budgets.joules", "horowitz_45nm, int_45nm or int_sram_45nm", model);
}

absl::Status TenantLimits::Validate() const {
  const auto refuse = [](const char* field, auto received) {
    return InvalidArgument(field, "a number of at least 0", received);
  };
  if (max_sessions.value_or(0) < 0) return refuse("max_sessions", *max_sessions);
  if (!std::isfinite(decisions_per_second) || decisions_per_second < 0.0) {
    return refuse("decisions_per_second", decisions_per_second);
  }
  for (const auto& [cost, name, rate] : RatesOf(calls_per_second)) {
    if (!std::isfinite(rate) || rate < 0.0) {
      return refuse(absl::StrCat("calls_per_second.", name).c_str(), rate);
    }
  }
  if (max_message_bytes < 0) return refuse("max_message_bytes", max_message_bytes);
  return CheckBudgetLimits(budgets);
}

void Tenant::SetLimits(const TenantLimits& limits, int64_t default_sessions) {
  max_sessions_.store(limits.max_sessions.value_or(default_sessions), std::memory_order_relaxed);
  max_message_bytes_.store(limits.max_message_bytes, std::memory_order_relaxed);
  max_durability_.store(limits.max_durability, std::memory_order_relaxed);
  decisions_.Set(limits.decisions_per_second);
  {
    absl::MutexLock lock(&budgets_mutex_);
    budgets_ = limits.budgets;
    JudgeBudgets();
  }
  for (const NamedRate& rate : RatesOf(limits.calls_per_second)) {
    calls_[static_cast<size_t>(rate.cost)].Set(rate.per_second);
  }
}

absl::Status Tenant::Acquire() {
  const int64_t limit = max_sessions_.load(std::memory_order_relaxed);
  if (sessions_.fetch_add(1, std::memory_order_relaxed) < limit || limit == 0) {
    return absl::OkStatus();
  }
  sessions_.fetch_sub(1, std::memory_order_relaxed);
  // When a session will close is unknown. One second keeps clients from retrying at once.
  return WithRetryDelay(
      absl::ResourceExhaustedError(absl::StrCat("max_sessions: expected fewer than ", limit,
                                                " open sessions of tenant ", name_, "; close one")),
      absl::Seconds(1));
}

absl::Status Tenant::AcquireDecision(absl::Duration now) {
  if (stops_open_.load(std::memory_order_relaxed)) RETURN_IF_ERROR(CheckBudgets());
  const absl::Duration wait = decisions_.Acquire(now);
  if (wait <= absl::ZeroDuration()) return absl::OkStatus();
  return WithRetryDelay(absl::ResourceExhaustedError(
                            absl::StrCat("decisions_per_second: the limit of tenant ", name_,
                                         " is reached; try again in ", absl::FormatDuration(wait))),
                        wait);
}

absl::Status Tenant::AcquireCall(Cost cost, absl::Duration now) {
  const absl::Duration wait = calls_[static_cast<size_t>(cost)].Acquire(now);
  if (wait <= absl::ZeroDuration()) return absl::OkStatus();
  return WithRetryDelay(absl::ResourceExhaustedError(absl::StrCat(
                            "calls_per_second.", NameOf(cost), ": the limit of tenant ", name_,
                            " is reached; try again in ", absl::FormatDuration(wait))),
                        wait);
}

std::vector<BudgetState> Tenant::StatesOfBudgets() const {
  std::vector<BudgetState> states;
  const auto add = [&](std::string name, double limit, double spent) {
    if (limit > 0.0) states.push_back({std::move(name), limit, spent});
  };
  add("decisions", budgets_.decisions, spent_[UsageField::kDecisions]);
  for (const auto& [model, limit] : budgets_.joules) {
    if (const auto field = FieldOfJoules(model); field.ok()) {
      add(absl::StrCat("joules.", model), limit, spent_[*field]);
    }
  }
  add("contributions", budgets_.contributions, spent_[UsageField::kContributions]);
  return states;
}

std::vector<BudgetState> Tenant::Budgets() const {
  absl::MutexLock lock(&budgets_mutex_);
  return StatesOfBudgets();
}

void Tenant::SetSpent(const UsageCounts& spent, absl::Time reset) {
  absl::MutexLock lock(&budgets_mutex_);
  spent_ = spent;
  if (std::exchange(reset_, reset) != reset) said_.clear();
  JudgeBudgets();
}

void Tenant::JudgeBudgets() {
  bool is_spent = false;
  for (const BudgetState& budget : StatesOfBudgets()) {
    const double ratio = budget.spent / budget.limit;
    is_spent = is_spent || ratio >= 1.0;
    const double level = ratio >= 1.0 ? 1.0 : ratio >= kAlertRatio ? kAlertRatio : 0.0;
    if (std::exchange(said_[budget.name], level) >= level) continue;
    LogWarning(level == 1.0 ? "budget of a tenant is spent" : "budget of a tenant is nearly spent",
               {{"tenant", name_},
                {"budget", budget.name},
                {"limit", absl::StrCat(budget.limit)},
                {"spent", absl::StrCat(budget.spent)},
                {"resets", absl::FormatTime(reset_, absl::UTCTimeZone())}});
  }
  is_spent_.store(is_spent, std::memory_order_relaxed);
  stops_open_.store(is_spent && budgets_.stop_open_sessions, std::memory_order_relaxed);
}

absl::Status Tenant::CheckBudgets() const {
  if (!is_spent_.load(std::memory_order_relaxed)) return absl::OkStatus();
  absl::MutexLock lock(&budgets_mutex_);
  for (const BudgetState& budget : StatesOfBudgets()) {
    if (budget.spent < budget.limit) continue;
    return absl::ResourceExhaustedError(
        absl::StrCat("budgets.", budget.name, ": expected less than ", budget.limit, " of tenant ",
                     name_, " in this month, received ", budget.spent, "; begins again at ",
                     absl::FormatTime("%Y-%m-%dT%H:%M:%SZ", reset_, absl::UTCTimeZone())));
  }
  return absl::OkStatus();
}

int64_t Tenant::LongestMessage(int64_t limit) const {
  const int64_t own = max_message_bytes_.load(std::memory_order_relaxed);
  return own == 0 ? limit : std::min(own, limit);
}

absl::Status Tenant::CheckMessage(int64_t bytes) const {
  const int64_t limit = max_message_bytes_.load(std::memory_order_relaxed);
  if (limit == 0 || bytes <= limit) return absl::OkStatus();
  return absl::ResourceExhaustedError(absl::StrCat("max_message_bytes: expected at most ", limit,
                                                   " for tenant ", name_, ", received ", bytes));
}

}  // namespace spikeserve
