// A thread that does one thing every so often.
#ifndef SERVER_BASE_PERIODIC_H_
#define SERVER_BASE_PERIODIC_H_

#include <functional>
#include <thread>

#include "absl/synchronization/notification.h"
#include "absl/time/time.h"

namespace spikeserve {

class Periodic {
 public:
  // Calls `work` from its thread whenever `interval` has passed since it last returned.
  Periodic(absl::Duration interval, std::function<void()> work);

  // Waits for work under way.
  ~Periodic();

 private:
  absl::Notification stop_;
  std::thread thread_;
};

}  // namespace spikeserve

#endif  // SERVER_BASE_PERIODIC_H_
