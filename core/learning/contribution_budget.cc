#include "core/learning/contribution_budget.h"

#include <iterator>

#include "core/contract/dcheck.h"

namespace spikeserve {

void ContributionBudget::Leave(const std::string& contributor) {
  const auto member = members_.find(contributor);
  SPIKESERVE_DCHECK(member != members_.end());  // Join() was called for it
  if (--member->second == 0) members_.erase(member);
}

std::vector<std::string> ContributionBudget::Members() const {
  std::vector<std::string> members;
  for (const auto& [name, sessions] : members_) {
    if (members.size() < kProtectedMembers) members.push_back(name);
  }
  return members;
}

bool ContributionBudget::Take(const std::string& contributor, absl::Duration now) {
  if (now - minute_ >= absl::Minutes(1)) {
    minute_ = now;
    total_in_minute_ = 0;
    for (auto& [name, account] : accounts_) account.in_minute = 0;
  }
  Account& account = accounts_[contributor];
  const int per_window = is_protected() ? kPerWindow : kTotalPerMinute;
  if (account.in_window >= per_window || account.in_minute >= kPerMinute ||
      total_in_minute_ >= kTotalPerMinute) {
    return false;
  }
  ++account.in_window;
  ++account.in_minute;
  ++total_in_minute_;
  return true;
}

bool ContributionBudget::IsSuspended(const std::string& contributor) const {
  const auto account = accounts_.find(contributor);
  return account != accounts_.end() && account->second.suspended_windows > 0;
}

void ContributionBudget::OnWindowEnd(bool bad) {
  for (auto it = accounts_.begin(); it != accounts_.end();) {
    Account& account = it->second;
    if (account.suspended_windows > 0) --account.suspended_windows;
    if (bad && is_protected() && account.in_window >= kPerWindow) {
      account.suspended_windows = kSuspendedWindows;
    }
    account.in_window = 0;
    // An empty account is as good as none.
    it = account == Account() ? accounts_.erase(it) : std::next(it);
  }
}

ContributionBudget::State ContributionBudget::state() const {
  State state;
  state.minute_ms = absl::ToInt64Milliseconds(minute_);
  state.total_in_minute = total_in_minute_;
  for (const auto& [name, account] : accounts_) {
    state.contributors.push_back(name);
    state.accounts.push_back(account);
  }
  return state;
}

void ContributionBudget::Restore(const State& state) {
  SPIKESERVE_DCHECK_EQ(state.contributors.size(), state.accounts.size());
  accounts_.clear();
  for (size_t i = 0; i < state.accounts.size(); ++i) {
    accounts_[state.contributors[i]] = state.accounts[i];
  }
  minute_ = absl::Milliseconds(state.minute_ms);
  total_in_minute_ = state.total_in_minute;
}

}  // namespace spikeserve
