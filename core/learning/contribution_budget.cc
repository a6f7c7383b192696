#include "core/learning/contribution_budget.h"

#include <algorithm>

namespace spikeserve {

bool ContributionBudget::Take(const std::string& contributor, absl::Duration now,
                              bool is_protected) {
  if (now - absl::Milliseconds(minute_ms) >= absl::Minutes(1)) {
    minute_ms = absl::ToInt64Milliseconds(now);
    total_in_minute = 0;
    for (Account& account : accounts) account.in_minute = 0;
  }
  const auto at = std::lower_bound(contributors.begin(), contributors.end(), contributor);
  const auto found = accounts.begin() + (at - contributors.begin());
  const bool is_known = at != contributors.end() && *at == contributor;
  if (!is_known) contributors.insert(at, contributor);
  Account& account = is_known ? *found : *accounts.insert(found, Account());
  const int per_window = is_protected ? kPerWindow : kTotalPerMinute;
  if (account.in_window >= per_window || account.in_minute >= kPerMinute ||
      total_in_minute >= kTotalPerMinute) {
    return false;
  }
  ++account.in_window;
  ++account.in_minute;
  ++total_in_minute;
  return true;
}

bool ContributionBudget::IsSuspended(const std::string& contributor) const {
  const auto [first, last] =
      std::equal_range(contributors.begin(), contributors.end(), contributor);
  return first != last &&
         accounts[static_cast<size_t>(first - contributors.begin())].suspended_windows > 0;
}

void ContributionBudget::OnWindowEnd(bool bad, bool is_protected) {
  size_t kept = 0;
  for (size_t i = 0; i < accounts.size(); ++i) {
    Account account = accounts[i];
    if (account.suspended_windows > 0) --account.suspended_windows;
    if (bad && is_protected && account.in_window >= kPerWindow) {
      account.suspended_windows = kSuspendedWindows;
    }
    account.in_window = 0;
    if (account == Account()) continue;  // as good as none
    accounts[kept] = account;
    contributors[kept++].swap(contributors[i]);
  }
  accounts.resize(kept);
  contributors.resize(kept);
}

}  // namespace spikeserve
