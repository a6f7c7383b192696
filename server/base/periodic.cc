#include "server/base/periodic.h"

#include <utility>

namespace spikeserve {

Periodic::Periodic(absl::Duration interval, std::function<void()> work)
    : thread_([this, interval, work = std::move(work)] {
        while (!stop_.WaitFor(interval)) work();
      }) {}

Periodic::~Periodic() {
  stop_.Notify();
  thread_.join();
}

}  // namespace spikeserve
