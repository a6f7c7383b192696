// Runs a function at regular intervals on its own thread.
#pragma once

#include <functional>
#include <thread>
#include <utility>

#include "absl/time/time.h"
#include "core/base/steady_wait.h"

namespace spikeserve {

class Periodic {
 public:
  // Calls `work` each time `interval` has passed since its last call returned. The first call comes
  // one `interval` after construction.
  Periodic(absl::Duration interval, std::function<void()> work)
      : thread_([this, interval, work = std::move(work)] {
          while (!stop_.WaitFor(interval)) work();
        }) {}

  // Stops the thread. Blocks until a running `work` has returned.
  ~Periodic() {
    stop_.Notify();
    thread_.join();
  }

 private:
  SteadyNotification stop_;
  std::thread thread_;
};

}  // namespace spikeserve
