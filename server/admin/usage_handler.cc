#include <array>
#include <cstdint>
#include <map>
#include <string>
#include <tuple>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/time/time.h"
#include "core/base/enum_names.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "server/admin/admin_handler.h"

namespace spikeserve {
namespace {

constexpr size_t kMostGroups = 20'000;

enum class GroupKey { kTenant, kPolicy, kVersion, kLabel, kDay, kHour };

constexpr std::array<EnumName<GroupKey>, 6> EnumNames(GroupKey) {
  return {{{GroupKey::kTenant, "tenant"},
           {GroupKey::kPolicy, "policy"},
           {GroupKey::kVersion, "version"},
           {GroupKey::kLabel, "label"},
           {GroupKey::kDay, "day"},
           {GroupKey::kHour, "hour"}}};
}

// Tenant, policy, version, label and first hour.
using UsageGroup = std::tuple<std::string, std::string, int64_t, std::string, int64_t>;

absl::StatusOr<absl::CivilMonth> ParseMonth(const std::string& text, absl::Time now) {
  if (text.empty()) return absl::ToCivilMonth(now, absl::UTCTimeZone());
  absl::CivilMonth month;
  // 2026-1 would be read, too.
  if (text.size() == 7 && absl::ParseCivilTime(text, &month)) return month;
  return InvalidArgument("month", "one such as 2026-11", Quoted(text));
}

void ToProto(const UsageCounts& counts, v1::Usage* usage) {
  const auto number = [&](UsageField field) { return static_cast<int64_t>(counts[field]); };
  usage->set_decisions(number(UsageField::kDecisions));
  usage->set_spikes(number(UsageField::kSpikes));
  for (const UsageField model : kJoulesFields) {
    if (counts[model] > 0.0) {
      (*usage->mutable_joules())[std::string(ToString(model))] = counts[model];
    }
  }
  usage->set_fresh(number(UsageField::kFresh));
  usage->set_held(number(UsageField::kHeld));
  usage->set_local(number(UsageField::kLocal));
  usage->set_safe(number(UsageField::kSafe));
  usage->set_session_seconds(counts[UsageField::kSessionSeconds]);
  usage->set_sessions(number(UsageField::kSessions));
  usage->set_contributions(number(UsageField::kContributions));
  usage->set_bytes(number(UsageField::kBytes));
  usage->set_refused_calls(number(UsageField::kRefusedCalls));
}

}  // namespace

absl::Status AdminHandler::GetUsage(CallContext& context, const v1::GetUsageRequest& request,
                                    v1::GetUsageResponse* response) const {
  const absl::Time now = parts_.ledger->Now();
  ASSIGN_OR_RETURN(const auto month, ParseMonth(request.month(), now));
  std::array<bool, 6> by = {};
  for (const std::string& name : request.by()) {
    ASSIGN_OR_RETURN(const auto key, ParseEnum<GroupKey>("by", name));
    by[static_cast<size_t>(key)] = true;
  }
  const auto has = [&](GroupKey key) { return by[static_cast<size_t>(key)]; };
  const absl::Time from = absl::FromCivil(month, absl::UTCTimeZone());
  const absl::Time to = absl::FromCivil(month + 1, absl::UTCTimeZone());
  const int64_t first_hour = absl::ToInt64Hours(from - absl::UnixEpoch());
  ASSIGN_OR_RETURN(const auto rows, parts_.ledger->Read(from, to));
  std::map<UsageGroup, UsageCounts> groups;
  for (const UsageRow& row : rows) {
    const UsageSeries series = UsageSeries::FromKey(row.series);
    if (!context.caller->CanRead(series.tenant)) continue;
    const int64_t start = has(GroupKey::kHour)  ? row.hour
                          : has(GroupKey::kDay) ? Truncate("d", row.hour)
                                                : first_hour;
    groups[{has(GroupKey::kTenant) ? series.tenant : "",
            has(GroupKey::kPolicy) ? series.policy : "",
            has(GroupKey::kVersion) ? series.version : 0, has(GroupKey::kLabel) ? series.label : "",
            start}] += row.counts;
    if (groups.size() > kMostGroups) {
      return absl::ResourceExhaustedError(absl::StrCat(
          "by: expected at most ", kMostGroups, " groups, received more; ask for fewer keys"));
    }
  }
  for (const auto& [group, counts] : groups) {
    v1::UsageRow* const row = response->add_rows();
    const auto& [tenant, policy, version, label, start] = group;
    row->set_tenant(tenant);
    row->set_policy(policy);
    row->set_version(version);
    row->set_label(label);
    row->set_start(start * 3600);
    ToProto(counts, row->mutable_usage());
  }
  for (const TenantBudgets& tenant : parts_.ledger->Budgets()) {
    if (!context.caller->CanRead(tenant.tenant)) continue;
    for (const BudgetState& state : tenant.budgets) {
      v1::TenantBudget* const budget = response->add_budgets();
      budget->set_tenant(tenant.tenant);
      budget->set_name(state.name);
      budget->set_limit(state.limit);
      budget->set_spent(state.spent);
    }
  }
  response->set_month(absl::FormatCivilTime(month));
  response->set_label_key(parts_.ledger->label());
  response->set_shared(parts_.ledger->is_shared());
  const auto next = absl::ToCivilMonth(now, absl::UTCTimeZone()) + 1;
  response->set_resets_at(absl::ToUnixSeconds(absl::FromCivil(next, absl::UTCTimeZone())));
  return absl::OkStatus();
}

}  // namespace spikeserve
