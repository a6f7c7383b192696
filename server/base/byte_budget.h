// Counts the bytes of requests and answers in flight, and bounds them.
//
// Thread-safe, without locks.
#pragma once

#include <atomic>
#include <cstdint>

namespace spikeserve {

class ByteBudget {
 public:
  // Counts `bytes`; fewer than 0 were freed. Returns false if more than `limit` bytes are in
  // flight now because of them. They count all the same, until the caller frees them.
  bool Count(int64_t bytes, int64_t limit) {
    return used_.fetch_add(bytes, std::memory_order_relaxed) + bytes <= limit || bytes <= 0;
  }

  int64_t used() const { return used_.load(std::memory_order_relaxed); }

 private:
  std::atomic<int64_t> used_ = 0;
};

}  // namespace spikeserve
