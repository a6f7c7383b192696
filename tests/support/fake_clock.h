// A clock whose time changes only when a test calls Advance(). Thread-safe.
#ifndef TESTS_SUPPORT_FAKE_CLOCK_H_
#define TESTS_SUPPORT_FAKE_CLOCK_H_

#include <atomic>

#include "core/base/clock.h"

namespace spikeserve {

class FakeClock final : public Clock {
 public:
  absl::Duration Now() const override { return absl::Nanoseconds(nanoseconds_.load()); }
  void Advance(absl::Duration duration) { nanoseconds_ += absl::ToInt64Nanoseconds(duration); }

 private:
  std::atomic<int64_t> nanoseconds_ = 0;
};

}  // namespace spikeserve

#endif  // TESTS_SUPPORT_FAKE_CLOCK_H_
