#include "core/learning/contribution_budget.h"

#include <iterator>

namespace spikeserve {

void ContributionBudget::Leave(const std::string& contributor) {
  const auto member = members_.find(contributor);
  if (--member->second == 0) members_.erase(member);
}

bool ContributionBudget::Take(const std::string& contributor, absl::Duration now) {
  if (now - minute_ >= absl::Minutes(1)) {
    minute_ = now;
    total_in_minute_ = 0;
    for (auto& [name, account] : accounts_) account.in_minute = 0;
  }
  Account& account = accounts_[contributor];
  const int per_window = is_protected() ? kPerWindow : kTotalPerMinute;
  if (account.suspended_windows > 0 || account.in_window >= per_window ||
      account.in_minute >= kPerMinute || total_in_minute_ >= kTotalPerMinute) {
    return false;
  }
  ++account.in_window;
  ++account.in_minute;
  ++total_in_minute_;
  return true;
}

void ContributionBudget::OnWindowEnd(bool bad) {
  for (auto it = accounts_.begin(); it != accounts_.end();) {
    Account& account = it->second;
    if (account.suspended_windows > 0) --account.suspended_windows;
    if (bad && is_protected() && account.in_window >= kPerWindow) {
      account.suspended_windows = kSuspendedWindows;
    }
    account.in_window = 0;
    const bool forget = account.suspended_windows == 0 && !members_.contains(it->first);
    it = forget ? accounts_.erase(it) : std::next(it);
  }
}

}  // namespace spikeserve
