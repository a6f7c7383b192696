// Bounds the memory that requests and answers in flight may use.
//
// Thread-safe, without locks.
#ifndef SERVER_TRANSPORT_BYTE_BUDGET_H_
#define SERVER_TRANSPORT_BYTE_BUDGET_H_

#include <atomic>
#include <cstdint>

namespace spikeserve {

class ByteBudget {
 public:
  // Admits `limit` bytes at a time.
  explicit ByteBudget(int64_t limit) : limit_(limit) {}

  // Counts `bytes`. Returns false, and counts nothing, if the limit would be exceeded.
  bool Acquire(int64_t bytes) {
    if (used_.fetch_add(bytes, std::memory_order_relaxed) + bytes <= limit_) return true;
    Release(bytes);
    return false;
  }
  void Release(int64_t bytes) { used_.fetch_sub(bytes, std::memory_order_relaxed); }

  int64_t used() const { return used_.load(std::memory_order_relaxed); }
  int64_t limit() const { return limit_; }

 private:
  const int64_t limit_;
  std::atomic<int64_t> used_ = 0;
};

}  // namespace spikeserve

#endif  // SERVER_TRANSPORT_BYTE_BUDGET_H_
