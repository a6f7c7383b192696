// The servers that share their settings and sessions, and which of them does what only one must do.
//
//   LiveServers replicas("b7");
//   replicas.SetAlive({"a1", "b7"});
//   if (replicas.IsMine(rollout.replica)) Judge(rollout);
//
// Thread-safe.
#pragma once

#include <algorithm>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"

namespace spikeserve {

class LiveServers {
 public:
  // `self` names this server; empty: it shares nothing.
  explicit LiveServers(std::string self = "") : self_(std::move(self)), alive_({self_}) {}

  const std::string& self() const { return self_; }

  // Sets the servers that are alive. This one always is.
  void SetAlive(const std::vector<std::string>& alive) {
    absl::MutexLock lock(&mutex_);
    alive_ = {alive.begin(), alive.end()};
    alive_.insert(self_);
  }

  // Returns how many servers are alive, at least 1.
  int count() const {
    absl::MutexLock lock(&mutex_);
    return static_cast<int>(alive_.size());
  }

  // Returns true if this server does the work of `owner`: it is the owner, or the first of those
  // that are alive while the owner is not.
  bool IsMine(const std::string& owner) const {
    absl::MutexLock lock(&mutex_);
    if (self_.empty() || owner == self_) return true;
    return !alive_.contains(owner) && *alive_.begin() == self_;
  }

 private:
  const std::string self_;
  mutable absl::Mutex mutex_;
  std::set<std::string> alive_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
