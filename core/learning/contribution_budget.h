// Decides whether a shared head accepts a contribution, so that one contributor can neither outvote
// the others nor flood the head.
//
//   budget.Join("a");
//   if (budget.Take("a", now)) {
//     if (!budget.IsSuspended("a")) merge();
//     judge();
//   }
//   budget.OnWindowEnd(/*bad=*/false);  // when the guard has judged a window
//
// A contributor is a session, or, for a head that several tenants share, a tenant. Every
// contributor may contribute kPerMinute times a minute, and all of them together kTotalPerMinute
// times. A head with at least kProtectedMembers members is protected: of the ReturnGuard::kWindow
// episodes of a window, one contributor may give kPerWindow, fewer than the quarter that the
// interquartile mean leaves out. A contributor that has given as many in a window that was bad is
// suspended for the next kSuspendedWindows windows: it contributes nothing, but its returns still
// count. Otherwise no window would end while all contributors are suspended.
//
// Equal calls of Take() and OnWindowEnd() leave equal accounts, whichever process counts them: what
// Join() and Leave() count matters only until CountMembers() is called.
//
// Not thread-safe.
#ifndef CORE_LEARNING_CONTRIBUTION_BUDGET_H_
#define CORE_LEARNING_CONTRIBUTION_BUDGET_H_

#include <cstddef>
#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "absl/time/time.h"

namespace spikeserve {

class ContributionBudget {
 public:
  static constexpr int kPerMinute = 120;
  static constexpr int kTotalPerMinute = 1200;
  static constexpr size_t kProtectedMembers = 5;
  static constexpr int kPerWindow = 4;
  static constexpr int kSuspendedWindows = 10;

  // Counts a session of `contributor`. Each Join() needs one Leave().
  void Join(const std::string& contributor) { ++members_[contributor]; }
  void Leave(const std::string& contributor);

  // Returns the contributors with a session, at most kProtectedMembers: more make no difference.
  std::vector<std::string> Members() const;

  // Replaces the count of Join() and Leave() by that of several processes.
  void CountMembers(size_t members) { counted_ = members; }

  // Returns true if the head has enough members to be protected.
  bool is_protected() const { return counted_.value_or(members_.size()) >= kProtectedMembers; }

  // Counts an episode and returns true if it is within the budget. `now` is the time of a
  // monotonic clock, the same clock in every call.
  bool Take(const std::string& contributor, absl::Duration now);

  // Returns true if the contributor has spoiled a window and must not contribute yet.
  bool IsSuspended(const std::string& contributor) const;

  // Starts a new window. `bad`: the guard has restored an earlier head.
  void OnWindowEnd(bool bad);

  struct Account {
    int in_window = 0;
    int in_minute = 0;
    int suspended_windows = 0;

    friend bool operator==(const Account&, const Account&) = default;
  };
  // All that decides about later contributions, except the members.
  struct State {
    std::vector<std::string> contributors;  // sorted
    std::vector<Account> accounts;          // of `contributors`
    int64_t minute_ms = 0;                  // start of the running minute, in milliseconds
    int total_in_minute = 0;

    friend bool operator==(const State&, const State&) = default;
  };
  State state() const;
  // Continues from `state`. REQUIRES: it has as many accounts as contributors.
  void Restore(const State& state);

 private:
  std::map<std::string, int> members_;  // open sessions by contributor
  std::optional<size_t> counted_;       // absent: the number of `members_`
  std::map<std::string, Account> accounts_;
  absl::Duration minute_;  // start of the running minute
  int total_in_minute_ = 0;
};

}  // namespace spikeserve

#endif  // CORE_LEARNING_CONTRIBUTION_BUDGET_H_
