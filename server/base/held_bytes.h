// Counts the bytes that one request holds, for the server and for its tenant, until they are freed.
//
// Not thread-safe, but any thread may destroy it.
#pragma once

#include <cstdint>
#include <memory>
#include <utility>

#include "server/base/byte_budget.h"

namespace spikeserve {

class HeldBytes {
 public:
  struct Budget {
    std::shared_ptr<ByteBudget> bytes;  // null: counts nothing
    int64_t most = 0;
  };

  HeldBytes(Budget all, Budget tenant) : all_(std::move(all)), tenant_(std::move(tenant)) {}
  ~HeldBytes() { Set(0); }
  HeldBytes(const HeldBytes&) = delete;
  HeldBytes& operator=(const HeldBytes&) = delete;

  // Counts `bytes` in place of what was counted before. Returns false if a limit is exceeded.
  bool Set(int64_t bytes) {
    const int64_t more = bytes - std::exchange(held_, bytes);
    const bool fits = Count(all_, more);
    return Count(tenant_, more) && fits;
  }

 private:
  static bool Count(const Budget& budget, int64_t more) {
    return budget.bytes == nullptr || budget.bytes->Count(more, budget.most);
  }

  const Budget all_;
  const Budget tenant_;
  int64_t held_ = 0;
};

}  // namespace spikeserve
