// A clock whose time changes only when a test calls Advance(). Thread-safe.
#pragma once

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
