// Decides whether a shared head accepts a contribution, so that one contributor can neither outvote
// the others nor flood the head.
//
//   if (budget.Take("a", now, is_protected)) {
//     if (!budget.IsSuspended("a")) merge();
//     judge();
//   }
//   budget.OnWindowEnd(/*bad=*/false, is_protected);  // when the guard has judged a window
//
// A contributor is a session, or, for a head that several tenants share, a tenant. Every
// contributor may contribute kPerMinute times a minute, and all of them together kTotalPerMinute
// times. A head with at least kProtectedMembers members is protected: of the ReturnGuard::kWindow
// episodes of a window, one contributor may give kPerWindow, fewer than the quarter that the
// interquartile mean leaves out. A contributor that has given as many in a window that was bad is
// suspended for the next kSuspendedWindows windows: it contributes nothing, but its returns still
// count. Otherwise no window would end while all contributors are suspended.
//
// A plain value: equal calls leave equal budgets, whichever process makes them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "absl/time/time.h"

namespace spikeserve {

struct ContributionBudget {
  static constexpr int kPerMinute = 120;
  static constexpr int kTotalPerMinute = 1200;
  static constexpr size_t kProtectedMembers = 5;
  static constexpr int kPerWindow = 4;
  static constexpr int kSuspendedWindows = 10;

  struct Account {
    int in_window = 0;
    int in_minute = 0;
    int suspended_windows = 0;

    friend bool operator==(const Account&, const Account&) = default;
  };

  std::vector<std::string> contributors;  // sorted
  std::vector<Account> accounts;          // of `contributors`
  int64_t minute_ms = 0;                  // start of the running minute, in milliseconds
  int total_in_minute = 0;

  // Counts an episode and returns true if it is within the budget. `now` is the time of a
  // monotonic clock, the same clock in every call.
  bool Take(const std::string& contributor, absl::Duration now, bool is_protected);

  // Returns true if the contributor has spoiled a window and must not contribute yet.
  bool IsSuspended(const std::string& contributor) const;

  // Starts a new window. `bad`: the guard has restored an earlier head.
  void OnWindowEnd(bool bad, bool is_protected);
};

}  // namespace spikeserve
