// Keeps gRPC from running more threads than the process may use processors.
//
// gRPC's callback API runs its handlers on half as many threads as the machine has processors, 2 to
// 16, also where the process is bound to fewer. They take turns at waiting for the network, which
// takes several futex calls and changes of thread a call. Where there is no processor for each,
// they also interrupt one another: what one of them was just deciding then waits for a whole slice
// of the scheduler's time.
#ifndef SERVER_SPARE_POLLERS_H_
#define SERVER_SPARE_POLLERS_H_

#include <grpcpp/channel.h>

#include <memory>

#include "absl/synchronization/notification.h"

namespace spikeserve {

// How many of gRPC's threads have no processor of their own. Another version of gRPC than the one
// this was written for may run another number, of which none is spare then.
int CountSparePollers();

// One thread makes and destroys it.
class SparePollers {
 public:
  // Parks `count` of gRPC's threads until this object is destroyed; fewer than it runs, or nobody
  // is left to answer.
  explicit SparePollers(int count);

  // Lets them go, for gRPC to end them.
  ~SparePollers() { released_->Notify(); }
  SparePollers(const SparePollers&) = delete;
  SparePollers& operator=(const SparePollers&) = delete;

 private:
  const std::shared_ptr<absl::Notification> released_;  // outlives this object in parked threads
  const std::shared_ptr<grpc::Channel> channel_;        // last: it may wait for them
};

}  // namespace spikeserve

#endif  // SERVER_SPARE_POLLERS_H_
