#include "server/access/tenant.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
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

}  // namespace

absl::Status TenantLimits::Validate() const {
  const auto refuse = [](const char* field, auto received) {
    return absl::InvalidArgumentError(
        absl::StrCat(field, ": expected a number of at least 0, received ", received));
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
  return absl::OkStatus();
}

void Tenant::SetLimits(const TenantLimits& limits, int64_t default_sessions) {
  max_sessions_.store(limits.max_sessions.value_or(default_sessions), std::memory_order_relaxed);
  max_message_bytes_.store(limits.max_message_bytes, std::memory_order_relaxed);
  max_durability_.store(limits.max_durability, std::memory_order_relaxed);
  decisions_.Set(limits.decisions_per_second);
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
