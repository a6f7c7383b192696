// Runs a function at regular intervals on its own thread.
#ifndef SERVER_BASE_PERIODIC_H_
#define SERVER_BASE_PERIODIC_H_

#include <functional>
#include <thread>

#include "absl/synchronization/notification.h"
#include "absl/time/time.h"

namespace spikeserve {

class Periodic {
 public:
  // Calls `work` each time `interval` has passed since its last call returned. The first call comes
  // one `interval` after construction.
  Periodic(absl::Duration interval, std::function<void()> work);

  // Stops the thread. Blocks until a running `work` has returned.
  ~Periodic();

 private:
  absl::Notification stop_;
  std::thread thread_;
};

}  // namespace spikeserve

#endif  // SERVER_BASE_PERIODIC_H_
