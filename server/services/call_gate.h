// Counts the calls in progress and refuses new ones while the server stops.
//
// Thread-safe, without locks.
#pragma once

#include <atomic>
#include <cstdint>

#include "absl/status/status.h"

namespace spikeserve {

class CallGate {
 public:
  // Counts a call. Returns UNAVAILABLE while draining: the call must be refused, but is counted.
  // Each Begin() needs one End().
  absl::Status Begin() {
    calls_.fetch_add(1, std::memory_order_relaxed);
    return draining_.load(std::memory_order_acquire) ? DrainingError() : absl::OkStatus();
  }
  void End() { calls_.fetch_sub(1, std::memory_order_release); }

  // Refuses calls from now on.
  void Drain() { draining_.store(true, std::memory_order_release); }

  int64_t calls() const { return calls_.load(std::memory_order_acquire); }

  // Returns the status of a call that the stopping server refuses or ends.
  static absl::Status DrainingError() {
    return absl::UnavailableError("draining: the server is stopping; call another server");
  }

 private:
  std::atomic<bool> draining_ = false;
  std::atomic<int64_t> calls_ = 0;
};

}  // namespace spikeserve
